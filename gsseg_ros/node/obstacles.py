"""Publishes on ~/obstacles where classes chosen by name stand, again and again, for planners such as Nav2."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from gsseg_core.data.class_names import class_ids
from gsseg_core.errors import GssegError, SettingsError
from gsseg_core.live.session import LiveSession
from gsseg_core.objects.occupied_cells import OPAQUE, occupied_cells
from gsseg_core.refine.settings import PAPER
from gsseg_core.scene.quaternions import half_axes
from gsseg_ros.cloud_messages import points_cloud
from gsseg_ros.node.complaints import OBSTACLES, Complaints
from gsseg_ros.node.parameters import Settings
from gsseg_ros.node.sim_time import steady_timer
from gsseg_ros.node.workspace import Workspace
from gsseg_ros.qos import overridable_publisher, sensor_data

RENEWAL_SECONDS = 2.0
"""How long cells are published anew as they are, at least, while views come in."""

MOST_BYTES = 500_000
"""What arrives best effort in another process; of more, much is lost."""

Cells = npt.NDArray[np.float32]


class _Kept(NamedTuple):
    """Cells, and what they were found of."""

    era: object
    settings: Settings
    version: int
    since: float  # s, `time.monotonic`
    cells: Cells


class Obstacles:
    """Publishes from activation to deactivation, while somebody listens and the parameter obstacle_classes names any.

    A cell is said once, by a point in its middle at the lowest height at which it is occupied. Best effort and
    periodic, as sensors do: a costmap that rolls along with the robot forgets what has left it, and has to hear of it
    again. What is known changes seldom, so that cells are found anew only then.
    """

    def __init__(self, node: LifecycleNode, workspace: Workspace, complaints: Complaints) -> None:
        self._node, self._workspace, self._complaints = node, workspace, complaints
        self._kept: _Kept | None = None
        self._publisher = overridable_publisher(node, PointCloud2, "~/obstacles", sensor_data())
        # In a group of its own, since to find cells takes a while.
        group = MutuallyExclusiveCallbackGroup()
        self._timer = steady_timer(node, 1 / workspace.settings.obstacle_rate, self.tick, group)

    def close(self) -> None:
        """Stop."""
        self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._publisher)

    def tick(self) -> None:
        """Publish, if there is somebody who listens."""
        settings = self._workspace.settings
        try:
            if not settings.obstacle_classes or not self._publisher.get_subscription_count():
                return
            cells = self._cells(settings)
            header = Header(stamp=self._node.get_clock().now().to_msg(), frame_id=settings.map_frame)
            self._publisher.publish(points_cloud(header, cells))
        except rclpy_implementation.InvalidHandle:  # Closed in this moment.
            return
        except GssegError as error:  # A reset in this moment.
            self._complaints.add(OBSTACLES, f"obstacles: {error}")
        except Exception as error:  # The next time all may be well again.
            self._complaints.add(OBSTACLES, f"obstacles: unexpected {type(error).__name__}: {error}")

    def _cells(self, settings: Settings) -> Cells:
        """Cells (M, 3) of the classes that count as obstacles, in the map."""
        session, kept, now = self._workspace.loaded, self._kept, time.monotonic()
        if session is None or not session.has_codes:
            self._kept = None
            return np.empty((0, 3), np.float32)
        version = session.version
        same = kept is not None and kept.era is session.era and kept.settings is settings
        if kept is not None and same and (kept.version == version or now - kept.since < RENEWAL_SECONDS):
            return kept.cells
        self._kept = _Kept(session.era, settings, version, now, self._found(session, settings))
        cells = self._kept.cells
        if cells.nbytes > MOST_BYTES:
            message = f"obstacles: {len(cells)} cells are {cells.nbytes / 1e6:.1f} MB, too much to arrive best effort"
            self._complaints.add(
                OBSTACLES, f"{message}; expected a larger obstacle_resolution, or fewer obstacle_classes"
            )
        return cells

    def _found(self, session: LiveSession, settings: Settings) -> Cells:
        """Find the cells, from what a request of ~/segment left at its defaults would publish now."""
        refine = replace(PAPER, k=settings.k, beta=settings.beta)
        result, place = session.segmentation(refine), settings.scene_to_map
        scene = session.scene_of(result)
        chosen = self._chosen(settings.obstacle_classes, result.class_names)
        index = np.flatnonzero(np.isin(result.labels, chosen) & (scene.opacities >= OPAQUE))
        return occupied_cells(
            place.points_to_map(scene.means[index]),
            place.scale * place.rotation @ half_axes(scene.quats[index], scene.scales[index]),
            settings.obstacle_resolution,
            settings.obstacle_min_height,
            settings.obstacle_max_height,
        )

    def _chosen(self, names: Sequence[str], class_names: dict[int, str]) -> list[int]:
        """Ids of classes; those that there are not (yet) are left out, and complained of."""
        chosen: list[int] = []
        for name in names:
            try:
                chosen += class_ids([name], class_names, "parameter obstacle_classes")
            except SettingsError as error:
                self._complaints.add(OBSTACLES, str(error))
        return chosen
