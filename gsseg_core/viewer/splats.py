"""Sends a scene to a browser as splats, and later only what has changed."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import viser

from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.quaternions import covariances
from gsseg_core.viewer.splat_chunks import BYTES_PER_GAUSSIAN, Key, Node, after, changes

_LARGEST = 200.0
"""The largest standard deviation is sent as this many units: its square fits a 16-bit float, and so do small ones."""


class Splats:
    """Centers and covariances of a scene in the units that browsers get, computed once for all of them.

    viser sends covariances as 16-bit floats, which know nothing below 6e-8: a millimetre squared, in metres, is hardly
    there. So the scene is sent in units of its own, and scaled back by each node.

    Parameters
    ----------
    scene : GaussianScene
        N Gaussians.

    Attributes
    ----------
    unit : float
        In units of the scene.
    """

    def __init__(self, scene: GaussianScene) -> None:
        self._scene = scene
        self.unit = float(scene.scales.max()) / _LARGEST

    @cached_property
    def centers(self) -> np.ndarray:
        """Means in units of `unit`, (N, 3) float32."""
        return self._scene.means / np.float32(self.unit)

    @cached_property
    def covariances(self) -> np.ndarray:
        """Covariances in units of `unit`, (N, 3, 3) float32."""
        return covariances(self._scene.quats, self._scene.scales / np.float32(self.unit))


class SplatNodes:
    """Sends the nodes of a scene to one browser, and remembers what it has.

    Parameters
    ----------
    client : viser.ClientHandle
        The browser.
    splats : Splats
        N Gaussians.

    Attributes
    ----------
    bytes_sent : int
        Of Gaussians, before compression, since the start.
    """

    def __init__(self, client: viser.ClientHandle, splats: Splats) -> None:
        self._client, self._splats = client, splats
        self._handles: dict[Key, viser.GaussianSplatHandle] = {}
        self._sent: dict[Key, Node] = {}
        self.bytes_sent = 0

    def show(self, wanted: dict[Key, Node]) -> None:
        """Show these nodes; what the browser has already is not sent again."""
        todo = changes(self._sent, wanted)
        with self._client.atomic():
            for key in todo.drop:
                self._handles.pop(key).remove()
            for key in todo.put:
                self._put(key, wanted[key])
            for key, visible in todo.switch.items():
                self._handles[key].visible = visible
        self._client.flush()
        self._sent = after(self._sent, wanted, todo)

    def _put(self, key: Key, node: Node) -> None:
        gaussians = {
            "centers": self._splats.centers[node.members],
            "covariances": self._splats.covariances[node.members],
            "rgbs": node.rgba[:, :3],
            "opacities": node.rgba[:, 3:],
        }
        self.bytes_sent += BYTES_PER_GAUSSIAN * len(node.members)
        if key in self._handles:
            self._handles[key].set_gaussians(**gaussians)
        else:
            name = f"/splats/{key[0]}/{key[1]}"
            self._handles[key] = self._client.scene.add_gaussian_splats(name, **gaussians, scale=self._splats.unit)
