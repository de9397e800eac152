"""Sends a scene to a browser as splats, and later only what has changed."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import viser

from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.quaternions import covariances
from gsseg_core.viewer.picture import Key, Node

_LARGEST = 200.0  # units of the largest standard deviation: its square fits a 16-bit float, and so do small ones


class Splats:
    """Centers and covariances of a scene in the units that browsers get, computed once for all of them.

    viser sends covariances as 16-bit floats, which know nothing below 6e-8: a millimetre squared, in metres, is hardly
    there. So the scene is sent in a `unit` of its own (in units of the scene), and scaled back by each node.
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
    """Sends the nodes of a scene to one browser, and remembers what it has."""

    def __init__(self, client: viser.ClientHandle, splats: Splats) -> None:
        self._client, self._splats = client, splats
        self._sent: dict[Key, tuple[viser.GaussianSplatHandle, Node]] = {}

    def show(self, wanted: dict[Key, Node]) -> None:
        """Show these nodes. What the browser has already is not sent again, and what nobody sees not before it is."""
        with self._client.atomic():
            for key in self._sent.keys() - wanted.keys():
                self._sent.pop(key)[0].remove()
            for key, node in wanted.items():
                handle, there = self._sent.get(key, (None, None))
                if node.visible and (there is None or not _alike(there, node)):
                    handle = self._send(handle, key, node)
                elif handle is None or there is None:
                    continue
                else:
                    node = there._replace(visible=node.visible)
                handle.visible = node.visible
                self._sent[key] = handle, node
        self._client.flush()

    def _send(self, handle: viser.GaussianSplatHandle | None, key: Key, node: Node) -> viser.GaussianSplatHandle:
        gaussians = {
            "centers": self._splats.centers[node.members],
            "covariances": self._splats.covariances[node.members],
            "rgbs": node.rgba[:, :3],
            "opacities": node.rgba[:, 3:],
        }
        if handle is None:
            name = f"/splats/{key[0]}/{key[1]}"
            return self._client.scene.add_gaussian_splats(name, **gaussians, scale=self._splats.unit)
        handle.set_gaussians(**gaussians)
        return handle


def _alike(a: Node, b: Node) -> bool:
    return np.array_equal(a.members, b.members) and np.array_equal(a.rgba, b.rgba)
