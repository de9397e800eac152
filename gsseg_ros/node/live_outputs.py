"""Publishes pictures on ~/overlay and the objects so far on ~/objects while views come in.

All of it is made in a thread of its own, only while somebody listens, and only of what is newest. Masks that wait to be
fused go first, but for a second at most: they may come faster than they are fused. It shows the class
probabilities of that moment, without refinement.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from builtin_interfaces.msg import Time
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import Header

from gsseg_core.errors import GssegError
from gsseg_core.export.pictures import overlay, palette
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.camera import Camera
from gsseg_core.segmentation import Segmentation
from gsseg_ros.conversions import color_from_image, require_size, rgb_image
from gsseg_ros.node.camera_streams import camera_of
from gsseg_ros.node.jobs import END_SECONDS
from gsseg_ros.node.masks.compressed import decompress_picture
from gsseg_ros.node.outputs import Outputs
from gsseg_ros.node.pairing import Paired
from gsseg_ros.node.reports import Selection
from gsseg_ros.node.workspace import Workspace

CODES_PERIOD, OBJECTS_PERIOD = 1.0, 2.0
"""Seconds for which pictures reuse a segmentation before it is made again, and between two messages of objects."""

IMAGE_SILENCE = 2.0
"""Seconds without a usable camera image until the classes are drawn without one."""

POSTPONED_SECONDS = 1.0
"""How long a picture or objects wait, at most, for the masks to be fused."""

_PAUSE = 0.05  # s, between two looks at whether masks still wait


class LiveOutputs:
    """Draws overlays and boxes objects in a thread, from activation to deactivation. Its methods return at once.

    `busy` says whether masks wait to be fused, `now` gives the stamp of this moment, `complain` is told what is wrong
    with a camera image.
    """

    def __init__(
        self,
        workspace: Workspace,
        outputs: Outputs,
        busy: Callable[[], bool],
        now: Callable[[], Time],
        complain: Callable[[str], None],
    ) -> None:
        self._workspace, self._outputs = workspace, outputs
        self._busy, self._now, self._complain = busy, now, complain
        self._changed = threading.Condition()
        self._pictures: dict[str, tuple[Paired, Camera | None]] = {}  # By stream.
        self._objects_due = False
        self._news: int | None = None  # `objects_count` when the newest view came whose objects nobody has been told
        self._stopping = False
        self._segmentation: tuple[tuple[object, int], float, Segmentation] | None = None
        self._last_image: dict[str, float] = {}
        self._last_objects = -np.inf
        self._thread = threading.Thread(target=self._run, name="live outputs", daemon=True)
        self._thread.start()

    def fused(self, paired: Paired, camera: Camera) -> None:
        """Take note of a mask that has been fused; what its camera sees is drawn if no image of it came lately."""
        self._news = self._outputs.objects_count
        if time.monotonic() - self._last_image.get(paired.stream, -np.inf) > IMAGE_SILENCE:
            self._show(paired, camera)

    def changed(self) -> None:
        """Take note that the scene or its votes have changed, so that objects are due as after a view."""
        self._news = self._outputs.objects_count

    def image(self, paired: Paired) -> None:
        """Take in a camera image with its pose, in the place of the mask."""
        self._last_image[paired.stream] = time.monotonic()
        self._show(paired, None)

    def tick(self) -> None:
        """See whether objects are due; call it some ten times a second.

        What a run has published since the newest view came stays: it is refined, or learnt.
        """
        if (
            self._news == self._outputs.objects_count
            and self._outputs.wants_objects
            and time.monotonic() - self._last_objects >= OBJECTS_PERIOD
        ):
            with self._changed:
                self._objects_due = True
                self._changed.notify()

    def show_objects(self) -> None:
        """Publish the objects so far, even if no view came since they were, and if nobody listens yet."""
        self._news = self._outputs.objects_count
        with self._changed:
            self._objects_due = True
            self._changed.notify()

    def close(self) -> None:
        """Finish what is in hand, and end."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        self._thread.join(END_SECONDS)

    def _show(self, paired: Paired, camera: Camera | None) -> None:
        if self._outputs.wants_overlay(paired.stream):
            with self._changed:
                self._pictures[paired.stream] = (paired, camera)
                self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._pictures or self._objects_due or self._stopping)
                latest = time.monotonic() + POSTPONED_SECONDS
                while self._busy() and not self._stopping and time.monotonic() < latest:
                    self._changed.wait(_PAUSE)
                if self._stopping:
                    return
                pictures, self._pictures = self._pictures, {}
                objects_due, self._objects_due = self._objects_due, False
            for picture in pictures.values():
                self._guarded(self._draw, *picture)
            if objects_due:
                self._guarded(self._publish_objects)

    def _guarded(self, work: Callable[..., None], *arguments: Any) -> None:
        try:
            work(*arguments)
        except GssegError as error:  # An image that cannot be used, or a reset in this moment.
            self._complain(str(error))
        except Exception as error:  # Nothing that is only to be looked at may end the thread.
            self._complain(f"overlay or objects: unexpected {type(error).__name__}: {error}")

    def _draw(self, paired: Paired, camera: Camera | None) -> None:
        session, header = self._workspace.session, paired.mask[1].header
        era = session.era
        if not session.has_codes:
            return
        photo = None
        if camera is None:
            camera, photo = self._photo(paired)
        result = self._current(CODES_PERIOD)
        colors = palette(result.num_classes)
        labels = result.render(make_operator(session.scene_of(result), camera, session.device)).labels
        picture = colors[labels] if photo is None else overlay(photo, labels, colors)
        header = Header(stamp=header.stamp, frame_id=header.frame_id)
        # A reset meanwhile has cleared the overlay.
        self._outputs.publish_overlay(rgb_image(picture, header), lambda: self._workspace.era is era, paired.stream)

    def _photo(self, paired: Paired) -> tuple[Camera, npt.NDArray[np.uint8]]:
        """Find camera and pixels (H, W, 3) of a camera image, undistorted where its lens is distorted."""
        settings = self._workspace.settings
        (topic, image), (info_topic, info) = paired.mask, paired.camera_info
        if isinstance(image, CompressedImage):
            image = decompress_picture(image, topic, settings.max_pixels)
        for message, source in ((image, topic), (info, info_topic)):
            require_size(message, settings.max_pixels, source)
        camera = camera_of(paired, (image.width, image.height), settings)
        photo = color_from_image(image, topic)
        return camera, photo if camera.undistortion is None else camera.undistortion.sample(photo, 0)

    def _publish_objects(self) -> None:
        session, settings = self._workspace.session, self._workspace.settings
        if not session.has_codes:
            return
        # What a run or a reset publishes while these are put together is newer.
        since = self._outputs.objects_count
        self._news = None
        result = self._current(0.0)  # What is told now stays until there is more news.
        selection = Selection(session, result, sorted(result.class_names), 0.0, settings.scene_to_map)
        header = Header(stamp=self._now(), frame_id=settings.map_frame)
        if self._outputs.publish_objects(selection.objects(header, revision=0), since) and self._news == since:
            self._news = self._outputs.objects_count  # A view came meanwhile.
        self._last_objects = time.monotonic()

    def _current(self, oldest: float) -> Segmentation:
        """Segmentation without refinement, as it is now or was so many seconds ago at most."""
        session = self._workspace.session
        key = (session.era, session.version)
        if self._segmentation is not None:
            kept, since, result = self._segmentation
            if kept == key or (kept[0] is key[0] and time.monotonic() - since < oldest):
                return result
        result = session.unrefined()
        self._segmentation = (key, time.monotonic(), result)
        return result
