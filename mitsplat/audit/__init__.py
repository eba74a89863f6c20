"""A dataset re-checked from its files alone.

In: a dataset's folder. Out: every violation: files are read by the formats' own readers and compared with what masks,
cameras and poses give anew (:mod:`.truth`). Nothing that wrote the dataset takes part.
"""

from __future__ import annotations

from mitsplat.audit.audit import Audit, audit_dataset

__all__ = ["Audit", "audit_dataset"]
