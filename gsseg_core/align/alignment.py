"""What was found of a dataset's frame: how its cameras are posed in a scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from gsseg_core.align.conventions import Convention
from gsseg_core.scene.camera import Camera
from gsseg_core.scene.similarity import Similarity


@dataclass(frozen=True, eq=False)
class Alignment:
    """Poses of a dataset's cameras in a scene: how they are to be understood, and then where their frame lies."""

    convention: Convention = field(default_factory=Convention)  # how poses are to be understood
    similarity: Similarity = field(default_factory=Similarity)  # from the frame that they are then in to the scene's

    def camera(self, camera: Camera) -> Camera:
        """Pose a camera of the dataset in the scene."""
        return self.similarity.camera(self.convention.camera(camera))

    @property
    def parts(self) -> list[str]:
        """What was found, for people; nothing where cameras are in the scene's frame as they are."""
        found, parts = self.similarity, self.convention.parts
        turn = Rotation.from_matrix(found.rotation).as_rotvec(degrees=True)
        if abs(found.scale - 1) > 1e-9:
            parts.append(f"scale {found.scale:.6g}")
        if (angle := float(np.linalg.norm(turn))) > 1e-6:
            axis = ", ".join(f"{part:.4f}" for part in turn / angle)
            parts.append(f"rotation by {angle:.4g} degrees about ({axis})")
        if np.abs(found.translation).max() > 1e-9:
            parts.append(f"translation ({', '.join(f'{part:.6g}' for part in found.translation)})")
        return parts

    def as_dict(self) -> dict[str, Any]:
        """Give it as `report.json` does; rotations and axes are 3 x 3, row by row."""
        return {
            "inverted": self.convention.inverted,
            "world_axes": self.convention.world_axes.tolist(),
            "camera_axes": self.convention.camera_axes.tolist(),
            "scale": self.similarity.scale,
            "rotation": self.similarity.rotation.tolist(),
            "translation": self.similarity.translation.tolist(),
        }
