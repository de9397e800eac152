"""Whether scene and cameras look as if they were in one frame; where they are not, views are fused all the same."""

from __future__ import annotations

from gsseg_core.align.agreement import Pictures, agreement, look_at
from gsseg_core.align.mask_fit import PIXELS, misplaced
from gsseg_core.align.settings import AlignSettings
from gsseg_core.live.results import Outcome
from gsseg_core.live.session import LiveSession
from gsseg_core.scene.gaussian_scene import GaussianScene

_SETTINGS = AlignSettings()


class FrameCheck:
    """Remembers what the views of the last learn job looked like, as long as what they were fused into is known."""

    def __init__(self) -> None:
        self._found: tuple[object, str] = (None, "")

    def look(self, session: LiveSession, scene: GaussianScene, outcome: Outcome) -> str:
        """Compare a scene with the views that were learnt from; return what is wrong, empty if nothing is."""
        pictures, shown = Pictures.of(scene, _SETTINGS, session.device), look_at(outcome.views, _SETTINGS)
        found = agreement(pictures, shown, _SETTINGS)
        said = ""
        if found is not None and found.nearness:
            said = found.nearness
        elif found is not None and found.agrees is False:
            said = (
                f"{found.doubt} ({found}): the two seem to be in different frames; expected poses of the camera's "
                "optical frame (x right, y down, z forward) in map_frame, and scene_to_map to say where the scene lies "
                "there"
            )
        elif told := str(misplaced(pictures, shown, outcome.views, _SETTINGS)):
            said = f"{told}; {PIXELS}, and poses of a calibrated camera at the stamps of its masks"
        self._found = session.era, said
        return said

    def problem(self, session: LiveSession) -> str:
        """Say again what `look` has found of this session; empty if nothing, or if its views were forgotten."""
        era, said = self._found
        return said if era is session.era else ""
