"""Records of a dataset folder: ``dataset.json`` and the lines of ``manifest.jsonl``.

In: files of a dataset, which may come from an untrusted source. Out: validated records of frames. It contains none of
the code that makes frames, so the audit can read datasets independently.
"""
