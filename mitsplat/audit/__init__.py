"""Independent audit of a dataset from its files alone.

In: a dataset folder. Out: every violation. Files are read by the readers of their formats, and compared with values
recomputed from masks, cameras and poses (:mod:`.decoded_frame`). The code that wrote the dataset is not used.
"""

from __future__ import annotations

from mitsplat.audit.audit import Audit, audit_dataset

__all__ = ["Audit", "audit_dataset"]
