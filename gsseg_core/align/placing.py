"""Cameras of a dataset put where they are in a scene: by nerfstudio's file, as the dataset has them, or as found."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from gsseg_core.align.agreement import Agreement, Pictures, Shown, agreement, far_off, look_at
from gsseg_core.align.conventions import Alignment, find_convention
from gsseg_core.align.features import PhotosInScene
from gsseg_core.align.mask_fit import LEAST, PIXELS, MaskFit, how_they_lie, masks_of, misplaced
from gsseg_core.align.settings import AlignSettings
from gsseg_core.data.camera_files import frame_of_training
from gsseg_core.data.camera_formats.dataparser import DATAPARSER
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.view import View
from gsseg_core.errors import AlignmentError, CameraFileError
from gsseg_core.files.input_files import is_there
from gsseg_core.progress import Progress, silent
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.similarity import Similarity

_LOST = 4.0  # standard deviations of Gaussians by which float32 moves them where a scene has lost what photos show
_CLOSE_PX = 1.0  # photos and renderings that are no farther apart lie upon each other


@dataclass(frozen=True, eq=False)
class Found:
    """An alignment that was found, and how well the scene agrees with the views by it."""

    alignment: Alignment  # where the cameras are
    agreement: Agreement  # of the scene, with what the cameras show there
    before: Agreement  # with the cameras where they were
    # Median distance of features of photos from those of renderings, px of photos 480 px long; None without photos.
    offset_px: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """Give it as `report.json` does."""
        return {**self.alignment.as_dict(), "offset_px": self.offset_px, "found": self.alignment.parts}


@dataclass(frozen=True, eq=False)
class Placed:
    """A dataset whose cameras are in the frame of a scene, as far as it is known."""

    dataset: Dataset  # its cameras moved
    dataparser: Path | None = None  # the file of nerfstudio that said where to, if there was one
    found: Found | None = None  # what was found, if that was asked for
    agreement: Agreement | None = None  # of scene and views, where it was looked at and views show anything
    masks: Agreement | None = None  # of scene and masks, where photos agree and masks have labels enough

    @property
    def fits(self) -> bool:
        """Whether nothing had to be found: cameras and masks were where they should be."""
        placed = self.agreement and self.agreement.agrees and not (self.found and self.found.alignment.parts)
        return bool(placed and not self.misplaced)

    @property
    def misplaced(self) -> str:
        """How masks lie beside what they show; "" where they do not."""
        return next((each.misplaced for each in (self.masks, self.agreement) if each and each.misplaced), "")

    def describe(self) -> str:
        """Say what was found, for people."""
        lines = [] if self.dataparser is None else [f"moved to the frame of nerfstudio's training by {self.dataparser}"]
        if self.found is None:
            return "\n".join([*lines, f"agreement: {self.agreement or 'no view shows anything'}"])
        if parts := self.found.alignment.parts:
            lines += [f"not aligned as it is ({self.found.before}); aligned by what --align does:"]
            lines += [f"  - {part}" for part in parts]
        lines += [f"aligned: {self.found.agreement}"]
        if nearness := self.found.agreement.nearness:
            lines += [f"too small: {nearness}"]
        if self.found.offset_px is not None:
            lines += [f"photos and renderings are {self.found.offset_px:.2f} px apart (median of their features)"]
        if self.misplaced:
            lines += [f"{self.misplaced}; {PIXELS}"]
        return "\n".join(lines)

    def as_dict(self) -> dict[str, Any]:
        """Give it as `report.json` does."""
        return {
            "dataparser": None if self.dataparser is None else str(self.dataparser),
            "agreement": None if self.agreement is None else vars(self.agreement),
            "masks": None if self.masks is None else vars(self.masks),
            "alignment": None if self.found is None else self.found.as_dict(),
        }


def place(
    scene: GaussianScene,
    dataset: Dataset,  # with photos or masks where these are needed
    *,
    align: bool = False,  # find where the cameras are; else they stay where they are
    check: bool = False,  # compare the scene with a few views
    dataparser: str | os.PathLike[str] | None = None,
    device: str = "cpu",
    progress: Progress = silent,
) -> Placed:
    """Put the cameras of a dataset where they are in a scene.

    `dataparser` is nerfstudio's `dataparser_transforms.json`, which lies beside the trained config; one beside the
    scene or in the dataset is found. Raises `AlignmentError` where no place is found for the cameras, and
    `CameraFileError` or `PoseError` where that file is broken, or says nothing of cameras of this format.
    """
    settings, file, found = AlignSettings(), None, None
    if framed := _frame_of_training(scene, dataset, dataparser):
        file, similarity = framed
        dataset = dataset.moved(similarity.camera)
    views = dataset.views("train") or dataset.views()
    if not align and not check:
        return Placed(dataset, file)
    pictures, seen = Pictures.of(scene, settings, device), None
    shown, masks = list[Shown](), None
    if align:
        found = _find_alignment(scene, views, pictures, settings, progress)
        dataset, seen = dataset.moved(found.alignment.camera), found.agreement
        views = dataset.views("train") or dataset.views()
    else:
        shown = look_at(views, settings)
        seen = agreement(pictures, shown, settings)
    if seen and seen.compared == "masks":
        few = shown or masks_of(views, settings)
        seen = replace(seen, misplaced=str(misplaced(pictures, few, views, settings)))
    elif seen and seen.agrees:
        few = masks_of(views, settings)
        if masks := agreement(pictures, few, settings):
            masks = replace(masks, misplaced=str(misplaced(pictures, few, views, settings)))
    return Placed(dataset, file, found, seen, masks)


def find_alignment(
    scene: GaussianScene,
    views: Sequence[View],
    settings: AlignSettings | None = None,
    device: str = "cpu",
    progress: Progress = silent,
) -> Found:
    """Find where cameras are in a scene, from what their photos show or, without photos, their masks.

    With photos, the cameras are tried as they are, then by conventions, and at last by a similarity; with masks, by
    conventions alone, which must agree clearly better than the cameras as they are. Taken is the first alignment by
    which photos and renderings lie upon each other, or else the one that agrees best. Raises `AlignmentError` where
    none agrees, or masks show too little to tell.
    """
    settings = settings or AlignSettings()
    return _find_alignment(scene, views, Pictures.of(scene, settings, device), settings, progress)


def _find_alignment(
    scene: GaussianScene, views: Sequence[View], pictures: Pictures, settings: AlignSettings, progress: Progress
) -> Found:
    shown = look_at(views, settings)
    before = agreement(pictures, shown, settings)
    if before is None:
        raise AlignmentError(
            "alignment: no view has a photo, or a mask with outlines; expected some, to see where cameras are by them"
        )
    told = far_off(scene.rounding) if scene.rounding >= _LOST else "" if before.agrees else before.nearness
    if told:  # To search takes minutes, and finds nothing.
        raise AlignmentError(f"alignment: {told}")
    if not before.telling and not before.agrees:
        raise AlignmentError(
            f"alignment: {before.doubt} ({before}); expected photos of the views in images/, or masks of more objects"
        )
    search, agreeing = _Search(scene, views, shown, before, pictures, settings), list[Found]()
    # Masks say less than photos do: the regions of a shelf may agree from a wrong side, too.
    if before.agrees and search.has_photos:
        as_they_are = search.closer(Alignment(), before)
        # Agreement alone is not enough: all sides of a table look alike.
        if as_they_are.offset_px is not None and as_they_are.offset_px <= _CLOSE_PX:
            return as_they_are
        agreeing.append(as_they_are)
    alignment = Alignment(find_convention(pictures, shown, settings, progress))
    reached = search.through(alignment)
    # Of a thousand conventions, the best agrees with masks a little better than the right one by chance.
    better = search.has_photos or (
        reached.margin >= before.margin + settings.mask_margins[0] and not search.masks_are_beside(alignment)
    )
    if before.agrees and not better:
        return Found(Alignment(), before, before)
    if reached.agrees and better:
        by_convention = search.closer(alignment, reached)
        if by_convention.offset_px is None or by_convention.offset_px <= settings.reprojection_px:
            return by_convention
        agreeing.append(by_convention)
    if not search.has_photos:
        how = f"; {search.masks}" if search.masks.change else ""
        raise AlignmentError(
            f"alignment: no convention of axes makes scene and masks agree ({reached} at best; cameras as they are: "
            f"{before}){how}; expected photos of the views in images/, by which scale, rotation and translation can be "
            "found, too"
        )
    try:
        agreeing.append(search.registered(progress))
    except AlignmentError:
        if not agreeing:
            raise
    return max(agreeing, key=lambda found: found.agreement.score)


@dataclass(frozen=True, eq=False)
class _Search:
    """A scene, and views whose cameras are looked for in it."""

    scene: GaussianScene
    views: Sequence[View]
    shown: list[Shown]  # by some of the views, at least one
    before: Agreement  # of the scene with these, with the cameras where they were
    pictures: Pictures  # of the scene
    settings: AlignSettings

    @property
    def has_photos(self) -> bool:
        """Whether views show photos, and not masks."""
        return self.before.compared == "photos"

    @cached_property
    def photos(self) -> PhotosInScene:
        """Photos that renderings are matched with."""
        return PhotosInScene.read(self.views, self.scene, self.settings, self.pictures.device)

    def registered(self, progress: Progress) -> Found:
        """Find a similarity by the photos."""
        from gsseg_core.align.refinement import offset_px, refined
        from gsseg_core.align.registration import LOOKING, candidates

        for guess in candidates(self.photos, progress):
            alignment = refined(self.photos, guess)
            reached = self.through(alignment)
            if reached.agrees:
                count = self.settings.virtual_views
                progress(LOOKING, count, count)
                return Found(alignment, reached, self.before, offset_px(self.photos, alignment))
        raise AlignmentError(
            f"alignment: no place in the scene looks like the {len(self.photos.photos)} photos; expected photos of "
            "this scene, with structure, and poses that differ from the scene's by a convention, a scale, a rotation "
            "and a translation"
        )

    @cached_property
    def masks(self) -> MaskFit:
        """How masks lie on what they show from the cameras where they were."""
        return misplaced(self.pictures, self.shown, self.views, self.settings)

    def masks_are_beside(self, alignment: Alignment) -> bool:
        """Whether masks would lie better on what they show after a change of their own than by an alignment."""
        if not self.masks.change:
            return False
        return how_they_lie(self.pictures, self.moved(alignment), fewest=1).as_they_are < LEAST * self.masks.best

    def moved(self, alignment: Alignment) -> list[Shown]:
        """Give what views show from cameras that are moved."""
        return [replace(view, camera=alignment.camera(view.camera)) for view in self.shown]

    def closer(self, alignment: Alignment, reached: Agreement) -> Found:
        """Refine an alignment by the photos, if there are any and they are not yet close to the renderings."""
        if not self.has_photos:
            return Found(alignment, reached, self.before)
        from gsseg_core.align.refinement import offset_px, refined

        offset = offset_px(self.photos, alignment)
        if offset is not None and offset > _CLOSE_PX:
            closer = refined(self.photos, alignment)
            closer_px = offset_px(self.photos, closer)
            if closer_px is not None and closer_px < offset:
                return Found(closer, self.through(closer), self.before, closer_px)
        return Found(alignment, reached, self.before, offset)

    def through(self, alignment: Alignment) -> Agreement:
        """Compare the scene with what views show, after their cameras are moved."""
        compared = agreement(self.pictures, self.moved(alignment), self.settings)
        assert compared is not None
        return compared


def _frame_of_training(
    scene: GaussianScene, dataset: Dataset, given: str | os.PathLike[str] | None
) -> tuple[Path, Similarity] | None:
    """Find nerfstudio's file, and the similarity that it states; None if there is none, or none is needed."""
    folders = [dataset.root] if scene.path is None else [scene.path.parent, dataset.root]
    beside = (path for folder in folders if is_there(path := folder / DATAPARSER, CameraFileError))
    for path in beside if given is None else (Path(given),):
        if (similarity := frame_of_training(dataset.root, path)) is not None:
            return path, similarity
    if given is not None:
        if not is_there(Path(given), CameraFileError):
            raise CameraFileError(f"{Path(given)}: does not exist; expected nerfstudio's {DATAPARSER}")
        raise CameraFileError(
            f"{Path(given)}: does not describe the cameras of {dataset.root}; expected those that nerfstudio trained "
            "from"
        )
    return None
