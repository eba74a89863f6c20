"""Result of a capture, with warnings about its photographs and the reason why it does not suffice."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mitsplat.arguments import list_first
from mitsplat.capture.capture import Capture
from mitsplat.capture.known_poses import MIN_REGISTERED
from mitsplat.capture.structure_from_motion import MIN_POINTS
from mitsplat.capture.video import ChosenFrames

_MAX_LISTED = 3
"""Maximum number of pictures that a warning lists, and of lenses that are listed."""

FEW_POINTS = 3 * MIN_POINTS
"""Number of observed points below which a camera causes a warning."""


@dataclass(frozen=True, eq=False)
class CaptureResult:
    """Result of the stage ``mitsplat capture``.

    Attributes:
        capture: Capture as stored in its folder.
        given: Number of input photographs, without those in ``unnamed`` and ``copies``.
        source: Origin of scale and gravity, as a clause.
        reprojection_error: Mean reprojection error over all observations [px].
        doubtful: Low fractions of matches that agree with the camera, by photo; without cameras that a board confirms.
        unnamed: Pictures in the folder that the given ``transforms.json`` does not name; they are left out.
        copies: Photos whose file is equal to that of another photo; they are left out.
        video: Chosen video frames, or None for photographs.
    """

    capture: Capture
    given: int
    source: str
    reprojection_error: float
    doubtful: Mapping[str, float]
    unnamed: Sequence[str] = ()
    copies: Sequence[str] = ()
    video: ChosenFrames | None = None

    @property
    def registered(self) -> float:
        """Fraction of the input photos that are in the capture."""
        return len(self.capture.photos) / self.given

    @property
    def exposure(self) -> str | None:
        """Range of the corrected exposure differences as a clause; None without correction."""
        gains = [np.log(photo.gain).mean() for photo in self.capture.photos if photo.gain is not None]
        return f"photos differ by up to {np.expm1(np.ptp(gains)):.0%}; this is corrected" if gains else None

    @property
    def lenses(self) -> str | None:
        """Focal lengths of the photos and their numbers as a clause; None for one lens, or one for each few photos."""
        counts = Counter(round(photo.camera.fx) for photo in self.capture.photos)
        if not 1 < len(counts) <= _MAX_LISTED:
            return None
        return " and ".join(f"{length} px in {count} photos" for length, count in sorted(counts.items()))

    @property
    def weak(self) -> dict[str, int]:
        """Number of observed points of photos that observe too few, by name."""
        counts = {photo.name: len(photo.seen) for photo in self.capture.photos}
        return {name: count for name, count in counts.items() if count < FEW_POINTS}

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about photos in the capture, one sentence each."""
        warnings = [] if self.video is None else [*self.video.warnings]
        if self.unnamed:
            text = f"the poses do not name {len(self.unnamed)} pictures in the folder, which are left out"
            warnings.append(f"{text}: {list_first(self.unnamed, _MAX_LISTED)}")
        if self.copies:
            text = f"{len(self.copies)} of the files are copies of other photos and are left out"
            warnings.append(f"{text}: {list_first(self.copies, _MAX_LISTED)}")
        if self.doubtful:
            shares = ", ".join(f"{name} ({share:.0%})" for name, share in sorted(self.doubtful.items()))
            warnings.append(
                f"cameras agree with few of their matches and may be wrong; remove these photos or add others: {shares}"
            )
        if not len(self.capture.points):
            warnings.append(
                "no point is seen alike by two photos with the cameras given, which may be wrong: are they of these "
                "photos, and in the axes of their format (transforms.json: y up, z backwards)?"
            )
        elif self.weak:
            warnings.append(f"few matched points; add photos with more overlap: {', '.join(self.weak)}")
        return tuple(warnings)

    @property
    def shortcoming(self) -> str | None:
        """Missed threshold and its remedy as a sentence, or None."""
        if self.registered >= MIN_REGISTERED:
            return None
        return (
            f"only {len(self.capture.photos)} of {self.given} photos ({self.registered:.0%}) could be used, "
            f"{MIN_REGISTERED:.0%} are required: take sharp photos of one object at steps of about ten degrees, with "
            "texture below it and even light"
        )
