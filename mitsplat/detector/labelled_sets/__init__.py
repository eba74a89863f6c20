"""Labelled images for training and evaluation.

Input: a folder of one of the kinds below. Output: a set of images and labelled objects. All images and labels are read
and checked first. A truncated image or label is therefore an error, and later readers cannot skip it silently.

======== ===============================================================================================================
kind     content of the folder
======== ===============================================================================================================
mitsplat ``dataset.json``, and files of the format ``yolo``
yolo     ``data.yaml`` with folders or lists of images, or ``classes.txt`` beside the folders ``images`` and ``labels``;
         labels lie at the paths that Ultralytics expects
coco     JSON files of ``images``, ``annotations`` and ``categories``, in the folder, in ``annotations`` or in folders
         of splits; images beside them or anywhere in the folder
======== ===============================================================================================================

Exact duplicates of a label count once, as in Ultralytics. A COCO category without labels that is only the supercategory
of others is no class; Roboflow writes one.
"""
