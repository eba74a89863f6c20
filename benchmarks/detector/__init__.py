"""Ablation of the generator for a detector: the published experiment, on real photographs."""
