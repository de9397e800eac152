"""Alignment: cameras in another frame than the scene are noticed, and put where they are."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage
from scipy.spatial.transform import Rotation

from gsseg_core.align import agreement as comparison
from gsseg_core.align import conventions, placing
from gsseg_core.align.agreement import Agreement, Pictures, agreement, look_at, render, thinned
from gsseg_core.align.conventions import AXIS_ROTATIONS, OPENGL, Convention
from gsseg_core.align.features import Features, Photo
from gsseg_core.align.placing import Found, find_alignment, place
from gsseg_core.align.registration import Located, fit_poses
from gsseg_core.align.settings import AlignSettings
from gsseg_core.cli.main import main
from gsseg_core.data.dataset import Dataset
from gsseg_core.data.label_images import write_mask
from gsseg_core.data.view import View, spread
from gsseg_core.errors import AlignmentError
from gsseg_core.export.view_pictures import background_image
from gsseg_core.raster.backends import make_operator
from gsseg_core.scene.camera import Camera, undistorted_camera
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.scene.lens import MODELS_BY_NAME, Lens
from gsseg_core.scene.similarity import Similarity
from gsseg_core.scene.undistortion import undistortions

SETTINGS = AlignSettings()
DISTURBED = Similarity(2.7, Rotation.from_rotvec([0.5, 2.0, -1.0]).as_matrix(), np.array([3.0, -1.0, 4.0]))
PHOTOS = 8
QUICK = ["--quiet", "--learner", "votes", "--no-knn", "--no-filter", "--views", "4", "--out"]


@pytest.fixture(scope="module")
def demo(demo_run: Path) -> Path:
    return demo_run / "scene"


@pytest.fixture(scope="module")
def scene(demo: Path) -> GaussianScene:
    return GaussianScene.load(demo / "scene.ply")


@pytest.fixture(scope="module")
def with_photos(demo: Path, scene: GaussianScene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo with photos of some views, a quarter brighter than they would be rendered."""
    folder = tmp_path_factory.mktemp("photos")
    for name in ("cameras.json", "classes.json"):
        shutil.copy(demo / name, folder)
    (folder / "images").mkdir()
    cameras = spread(Dataset(demo).cameras, PHOTOS)
    for camera in cameras:
        image = background_image(scene, make_operator(scene, camera)).astype(float)
        Image.fromarray((1.25 * image).clip(0, 255).astype(np.uint8)).save(folder / f"images/{camera.name}.png")
    train = [camera.name for camera in cameras]
    (folder / "split.json").write_text(json.dumps({"train": train, "test": []}))
    return folder


@pytest.fixture
def few_views(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have frames found by fewer and smaller pictures than usual, which takes a fraction of the time."""
    few = replace(SETTINGS, views=3, survivors=0.05, picture_px=64, photos=4, photo_px=240)
    monkeypatch.setattr(placing, "AlignSettings", lambda: few)


@pytest.fixture
def few_axes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the world's axes turned in a few ways where a test is not about finding one among all."""
    few = [axes for number in (4, 9, 17) for axes in (AXIS_ROTATIONS[number], AXIS_ROTATIONS[number].T)]
    monkeypatch.setattr(conventions, "AXIS_ROTATIONS", [np.eye(3), *few])


def poses_apart(first: Dataset, second: Dataset) -> float:
    pairs = zip(first.cameras, second.cameras, strict=True)
    return max(float(np.abs(a.world_to_camera - b.world_to_camera).max()) for a, b in pairs)


def pixels_apart(scene: GaussianScene, first: Dataset, second: Dataset) -> float:
    """Largest over views of the median distance in px of where points of the scene are seen."""
    apart = []
    for a, b in zip(first.cameras, second.cameras, strict=True):
        pixels = a.project(scene.means[::50])[0]
        inside = ((pixels >= 0) & (pixels < (a.width, a.height))).all(axis=1)
        offsets = np.linalg.norm(pixels[inside] - b.project(scene.means[::50][inside])[0], axis=1)
        apart.append(float(np.nanmedian(offsets)))
    return max(apart)


def test_cameras_that_fit_are_said_to_fit_by_masks_and_by_photos(
    demo: Path, with_photos: Path, scene: GaussianScene
) -> None:
    for folder, compared in ((demo, "masks"), (with_photos, "photos")):
        found = place(scene, Dataset(folder), check=True).agreement
        assert found is not None and found.agrees and found.compared == compared


def test_masks_whose_ids_classes_json_does_not_name_tell_as_well_where_cameras_are(
    demo: Path, scene: GaussianScene, tmp_path: Path
) -> None:
    for name in ("cameras.json", "classes.json", "split.json"):
        shutil.copy(demo / name, tmp_path)
    for view in Dataset(demo).views("train"):
        labels = view.read_labels()
        write_mask(tmp_path / f"own/{view.name}.png", np.where(labels > 0, labels + 100, labels), 8)
    own, named = (place(scene, Dataset(*of), check=True).agreement for of in ((tmp_path, "own"), (demo,)))
    assert own is not None and own == named


@pytest.mark.parametrize("folder", ["demo", "with_photos"])
def test_cameras_of_another_frame_are_said_not_to_fit(
    folder: str, scene: GaussianScene, request: pytest.FixtureRequest
) -> None:
    dataset = Dataset(request.getfixturevalue(folder)).moved(DISTURBED.camera)
    found = place(scene, dataset, check=True).agreement
    assert found is not None and found.agrees is False


def test_real_scenes_are_never_said_not_to_fit(real_data: Path) -> None:
    for name in ("fern", "kitchen_table", "replica_apartment", "shelf", "workbench"):
        scene, dataset = GaussianScene.load(real_data / name / "scene.ply"), Dataset(real_data / name, "labels_noisy")
        views = dataset.views("train")
        for shown in (views, [replace(view, image_path=None) for view in views if view.has_mask]):
            found = agreement(Pictures.of(scene, SETTINGS), look_at(shown, SETTINGS), SETTINGS)
            assert found is None or found.agrees, (name, found)


def test_the_border_of_an_image_that_a_lens_bent_is_no_edge(tmp_path: Path) -> None:
    lens = Lens(MODELS_BY_NAME["OPENCV"], 320, 320, (304.0, 304.0), (160.0, 160.0), (0.25, 0.3))  # like a pincushion
    (undistortion,) = undistortions(lens)
    assert undistortion.reached[149, 149] and not undistortion.reached[0, 0]
    Image.new("RGB", (320, 320), "white").save(tmp_path / "white.png")
    view = View(undistorted_camera("white", undistortion, np.eye(4)), image_path=tmp_path / "white.png")
    (shown,) = look_at([view], SETTINGS)
    assert shown.seen.mean() > 0.7 and shown.edges.max() > 0.5
    assert shown.edges[shown.seen].max() < 0.1


def test_views_that_show_nothing_are_not_judged(demo: Path, scene: GaussianScene, tmp_path: Path) -> None:
    for camera in Dataset(demo).cameras:
        write_mask(tmp_path / f"{camera.name}.png", np.zeros((camera.height, camera.width), np.int32), 8)
    for labels in ("no_such_folder", str(tmp_path)):
        assert place(scene, Dataset(demo, labels), check=True).agreement is None
        with pytest.raises(AlignmentError, match="no view has a photo, or a mask with outlines"):
            place(scene, Dataset(demo, labels), align=True)


def test_an_eighth_of_the_gaussians_tells_whether_cameras_fit(
    demo: Path, with_photos: Path, scene: GaussianScene
) -> None:
    few = thinned(scene, len(scene) // 8)
    assert len(few) == len(scene) // 8 and thinned(scene, len(scene)) is scene
    assert np.array_equal(few.means, thinned(scene, len(scene) // 8).means)
    assert (few.opacities > 0).all() and (few.opacities < 1).all()
    for folder in (demo, with_photos):
        for dataset, fits in ((Dataset(folder), True), (Dataset(folder).moved(DISTURBED.camera), False)):
            found = agreement(Pictures.of(few, SETTINGS), look_at(dataset.views("train"), SETTINGS), SETTINGS)
            assert found is not None and found.agrees is fits, (folder, found)


def test_a_focal_length_of_next_to_nothing_does_no_harm() -> None:
    camera = Camera("wide", 8, 6, np.array([[1e-310, 0, 4], [0, 1e-310, 3], [0, 0, 1]]), np.eye(4))
    (shown,) = look_at([View.from_arrays(camera, np.eye(6, 8, dtype=np.int32))], AlignSettings())
    assert np.isfinite(shown.edges).all() and np.isfinite(shown.camera.K).all()


@pytest.mark.parametrize("focal", [(1e38, 1e-38), (1e12, 1e-12), (1e-38, 1e38), (1e308, 1e308), (1e-308, 1e-308)])
def test_no_focal_length_ends_in_an_error_of_pillow(focal: tuple[float, float]) -> None:
    camera = Camera("v", 64, 48, np.array([[focal[0], 0, 32], [0, focal[1], 24], [0, 0, 1]]), np.eye(4))
    shown = look_at([View.from_arrays(camera, np.arange(64 * 48).reshape(48, 64) % 3)], AlignSettings())
    assert len(shown) == 1 and np.isfinite(shown[0].edges).all()


@pytest.mark.parametrize("side", [1, 3, 96])
def test_pictures_are_filtered_as_scipy_does(side: int) -> None:
    picture = np.random.default_rng(side).random((side, side), np.float32)
    blurred = comparison._filtered(picture, comparison._BLUR, comparison._BLUR)
    np.testing.assert_allclose(blurred, ndimage.gaussian_filter(picture, 1), rtol=1e-5)
    slopes = comparison._gradient(picture)
    np.testing.assert_allclose(slopes, ndimage.gaussian_gradient_magnitude(picture, 1), atol=1e-5)
    assert slopes.dtype == blurred.dtype == np.float32


def test_turning_a_picture_is_turning_its_camera(demo: Path, scene: GaussianScene) -> None:
    camera = look_at(Dataset(demo).views(), SETTINGS)[0].camera
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    for quarters in range(4):
        turned = Convention(camera_axes=np.linalg.matrix_power(quarter, quarters)).camera(camera)
        expected = render(scene, turned).colours
        np.testing.assert_allclose(render(scene, camera).turned(quarters).colours, expected, atol=2e-3)


def test_the_conventions_are_the_24_rotations_from_axes_to_axes() -> None:
    assert len({axes.tobytes() for axes in AXIS_ROTATIONS}) == 24
    assert all(np.allclose(axes @ axes.T, np.eye(3)) and np.linalg.det(axes) > 0.5 for axes in AXIS_ROTATIONS)
    assert Convention().parts == []


@pytest.mark.usefixtures("few_views")
@pytest.mark.parametrize(
    ("folder", "convention"),
    [
        ("demo", Convention(camera_axes=OPENGL)),
        ("with_photos", Convention(inverted=True, world_axes=AXIS_ROTATIONS[17])),
    ],
)
def test_conventions_are_found_exactly(
    folder: str, convention: Convention, scene: GaussianScene, request: pytest.FixtureRequest
) -> None:
    true = Dataset(request.getfixturevalue(folder))
    placed = place(scene, true.moved(convention.camera), align=True)
    assert placed.agreement is not None and placed.agreement.agrees and not placed.fits
    assert poses_apart(placed.dataset, true) < 1e-9
    assert "not aligned as it is" in placed.describe() and "aligned: " in placed.describe()


@pytest.mark.usefixtures("few_axes")
@pytest.mark.parametrize("number", [4, 17])  # the second is 1.5 px off, by the few features that match
def test_a_table_seen_from_another_side_is_not_taken_for_right_because_it_looks_alike(
    real_data: Path, number: int
) -> None:
    scene, true = GaussianScene.load(real_data / "kitchen_table/scene.ply"), Dataset(real_data / "kitchen_table")
    turned = true.moved(Convention(world_axes=AXIS_ROTATIONS[number]).camera)
    few = replace(SETTINGS, views=3, photos=3, survivors=0.02, photo_px=320, refinements=1)
    found = find_alignment(scene, turned.views("train"), few)
    assert found.before.agrees
    assert poses_apart(turned.moved(found.alignment.camera), true) < 1e-9


@pytest.mark.usefixtures("few_views", "few_axes")
def test_where_photos_and_renderings_lie_upon_each_other_nowhere_what_agrees_best_is_taken(
    with_photos: Path, scene: GaussianScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(placing._Search, "closer", lambda search, *found: Found(*found, search.before, 29.0))
    asked = []

    def nowhere(*_: object) -> Found:
        asked.append(True)
        raise AlignmentError("no place looks as the photos do")

    monkeypatch.setattr(placing._Search, "registered", nowhere)
    found = find_alignment(scene, Dataset(with_photos).views(), replace(SETTINGS, survivors=0.01, picture_px=48))
    assert asked and found.alignment.parts == [] and found.offset_px == 29.0


@pytest.mark.parametrize(
    "convention", [Convention(), Convention(camera_axes=OPENGL), Convention(True, camera_axes=AXIS_ROTATIONS[7])]
)
def test_poses_of_located_photos_make_a_similarity_whatever_axes_cameras_have_and_a_wrong_one_does_no_harm(
    demo: Path, convention: Convention
) -> None:
    true = spread(Dataset(demo).cameras, 6)
    nothing = Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    photos = [Photo(convention.camera(DISTURBED.camera(camera)), nothing) for camera in true]
    found = {number: Located(camera, 20) for number, camera in enumerate(true)}
    found[2] = Located(DISTURBED.camera(true[2]), 20)
    alignment = fit_poses(photos, found)
    assert alignment is not None
    for photo, camera in zip(photos, true, strict=True):
        np.testing.assert_allclose(alignment.camera(photo.camera).world_to_camera, camera.world_to_camera, atol=1e-6)


@pytest.mark.usefixtures("few_axes")
def test_a_similarity_of_a_real_scene_is_found_to_a_fraction_of_a_pixel(real_data: Path) -> None:
    scene, true = GaussianScene.load(real_data / "kitchen_table/scene.ply"), Dataset(real_data / "kitchen_table")
    moved = true.moved(DISTURBED.camera)
    settings = replace(SETTINGS, views=3, photos=5, survivors=0.01, picture_px=64, photo_px=320)
    found = find_alignment(scene, moved.views("train"), settings)
    assert found.alignment.similarity.scale == pytest.approx(1 / DISTURBED.scale, rel=1e-2)
    assert pixels_apart(scene, moved.moved(found.alignment.camera), true) < 1
    assert found.offset_px is not None and found.offset_px < 1


@pytest.mark.usefixtures("few_views", "few_axes")
def test_what_is_a_little_off_is_brought_closer(with_photos: Path, scene: GaussianScene) -> None:
    true = Dataset(with_photos)
    nudge = Similarity(1.0, Rotation.from_rotvec([0.01, 0, 0]).as_matrix(), np.zeros(3))
    placed = place(scene, true.moved(nudge.camera), align=True)
    assert pixels_apart(scene, true.moved(nudge.camera), true) > 2
    assert pixels_apart(scene, placed.dataset, true) < 1


@pytest.mark.usefixtures("few_axes")
def test_without_photos_a_similarity_is_refused_with_the_way_out(demo: Path, scene: GaussianScene) -> None:
    quick = replace(SETTINGS, views=4, survivors=0.01, picture_px=48)
    with pytest.raises(AlignmentError, match="expected photos of the views in images/"):
        find_alignment(scene, Dataset(demo).moved(DISTURBED.camera).views("train"), quick)


def write_moved(source: Path, target: Path, move: Callable[[Camera], Camera]) -> Path:
    """Copy a dataset with links, its cameras moved."""
    target.mkdir()
    for path in source.iterdir():
        if path.name != "cameras.json":
            (target / path.name).symlink_to(path)
    entries = json.loads((source / "cameras.json").read_text())
    for entry, camera in zip(entries, Dataset(source).cameras, strict=True):
        moved = move(camera)
        entry |= {"position": moved.center.tolist(), "rotation": moved.world_to_camera[:3, :3].T.tolist()}
    (target / "cameras.json").write_text(json.dumps(entries))
    return target


@pytest.mark.usefixtures("few_views", "few_axes")
def test_doctor_says_what_makes_cameras_fit_and_whether_they_did(
    demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    turned = write_moved(demo, tmp_path / "turned", Convention(camera_axes=OPENGL).camera)
    assert main(["doctor", str(demo), "--scene", str(demo / "scene.ply"), "--quiet"]) == 0
    assert capsys.readouterr().out.startswith("aligned: ")
    assert main(["doctor", str(turned), "--scene", str(demo / "scene.ply"), "--quiet"]) == 2
    assert "as in OpenGL" in capsys.readouterr().out
    assert main(["doctor", "--scene", str(demo / "scene.ply")]) == 2
    assert "expected a dataset as well" in capsys.readouterr().err


@pytest.mark.parametrize("turned", [False, True])
def test_masks_that_do_not_belong_to_photos_that_fit_are_said_not_to(
    turned: bool, demo: Path, with_photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = Path(shutil.copytree(with_photos, tmp_path / "data"))
    for view in Dataset(demo).views("train"):
        labels = view.read_labels()
        write_mask(data / f"labels/{view.name}.png", labels[::-1, ::-1] if turned else labels, 8)
    assert main(["segment", str(demo / "scene.ply"), "--data", str(data), *QUICK, str(tmp_path / "out")]) == 0
    assert ("like the masks from these cameras, but like the photos" in capsys.readouterr().err) == turned


SMALL, FAR = "of what cameras look at is nearer to them than 0.01", "the scene is so far from its origin that float32"


@pytest.mark.parametrize(
    ("scale", "offset", "exit_code", "said"), [(0.012, 0, 0, SMALL), (0.006, 0, 2, SMALL), (1.0, 1e7, 2, FAR)]
)
def test_that_a_scene_is_too_small_or_too_far_off_is_said_at_once_and_everywhere(
    scale: float, offset: float, exit_code: int, said: str, demo: Path, scene: GaussianScene, tmp_path: Path,
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    frame = Similarity(scale, np.eye(3), np.full(3, offset))
    data, file = write_moved(demo, tmp_path / "data", frame.camera), f"{tmp_path}/scene.ply"
    means, scales = frame.points(scene.means), scene.scales * scale
    GaussianScene.from_arrays(means, scene.quats, scales, scene.opacities, scene.sh).save(file)
    monkeypatch.setattr(placing, "find_convention", lambda *_: pytest.fail("looked for, in vain and for minutes"))
    monkeypatch.setattr(placing._Search, "has_photos", True)
    monkeypatch.setattr(placing._Search, "closer", lambda _, *found: Found(*found, found[1], 0.2))
    assert main(["doctor", str(data), "--scene", file, "--quiet"]) == exit_code
    assert said in "".join(capsys.readouterr())
    assert main(["segment", file, "--data", str(data), *QUICK, str(tmp_path / "out")]) == 0
    assert said in capsys.readouterr().err and said[1:] in (tmp_path / "out/report.html").read_text()


@pytest.mark.usefixtures("few_views", "few_axes")
def test_segment_warns_too_where_nobody_can_tell_whether_cameras_fit(
    demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(placing, "agreement", lambda *_: Agreement("masks", 6, 0.34, 0.28, None))
    assert main(["segment", str(demo / "scene.ply"), "--data", str(demo), *QUICK, str(tmp_path / "out")]) == 0
    assert "hardly looks like the masks from these cameras" in capsys.readouterr().err


@pytest.mark.usefixtures("few_views", "few_axes")
def test_segment_warns_in_one_line_of_cameras_that_do_not_fit_and_align_mends_it(
    demo: Path, demo_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    turned = write_moved(demo, tmp_path / "turned", Convention(world_axes=AXIS_ROTATIONS[9]).camera)
    lost = write_moved(demo, tmp_path / "lost", DISTURBED.camera)
    scene = str(demo / "scene.ply")
    assert main(["segment", scene, "--data", str(lost), *QUICK, str(tmp_path / "out")]) == 0
    assert capsys.readouterr().err.count("try --align") == 1
    assert "The scene does not look like the masks from these cameras" in (tmp_path / "out/report.html").read_text()
    assert json.loads((tmp_path / "out/report.json").read_text())["frame"]["agreement"]["agrees"] is False

    assert main(["segment", scene, "--data", str(turned), *QUICK, str(tmp_path / "out"), "--align"]) == 0
    assert capsys.readouterr().err == ""
    frame = json.loads((tmp_path / "out/report.json").read_text())["frame"]
    assert frame["agreement"]["agrees"] is True
    np.testing.assert_allclose(frame["alignment"]["world_axes"], AXIS_ROTATIONS[9].T)

    found = ["--segmentation", str(tmp_path / "out/segmentation.npz"), "--out", str(tmp_path / "maps")]
    for given, notes in (([], 1), (["--align"], 0)):  # Without, it renders the scene from where no camera was.
        assert main(["render", scene, "--data", str(turned), *found, "--quiet", *given]) == 0
        assert capsys.readouterr().err.count("that run moved the cameras by --align (") == notes
