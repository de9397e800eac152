"""Masks in the formats of other programs, written from label images: any label image comes back pixel by pixel.

An outline of any shape is written as rectangles, one for each run of pixels in a row.
"""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from PIL import Image

Labels = Mapping[str, np.ndarray]  # view -> (H, W)
Names = Mapping[int, str]
Writer = Callable[[Path, Labels, Names], Path]
"""Writes masks into a new folder, and returns what `--labels` is to name."""

AMG_HEADER = (
    "id,area,bbox_x0,bbox_y0,bbox_w,bbox_h,point_input_x,point_input_y,predicted_iou,stability_score,"
    "crop_box_x0,crop_box_y0,crop_box_w,crop_box_h"
)


def rectangles(inside: np.ndarray) -> list[list[float]]:  # (H, W)
    """Rectangles [x0, y0, x1, y1] that cover a mask, one for each run in a row."""
    edges = np.diff(np.pad(inside.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    starts, ends = np.argwhere(edges == 1), np.argwhere(edges == -1)
    return [[float(x0), float(y), float(x1), float(y + 1)] for (y, x0), (_, x1) in zip(starts, ends, strict=True)]


def corners(box: list[float]) -> list[list[float]]:
    x0, y0, x1, y1 = box
    return [[x0, y0], [x1, y0], [x1, y1], [x0, y1]]


def cropped(inside: np.ndarray) -> tuple[int, int, np.ndarray]:
    """Left, top, and what is in the smallest rectangle with all of a mask."""
    rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
    return int(columns[0]), int(rows[0]), inside[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]


def runs(inside: np.ndarray, order: str = "F") -> list[int]:
    """Lengths of runs of a mask, down the columns or (C) along the rows, the first of pixels outside."""
    flat = inside.ravel(order=order).astype(np.int8)
    changes = np.flatnonzero(np.diff(np.concatenate([[0], flat]))).tolist()
    return np.diff([0, *changes, flat.size]).tolist()


def compressed(counts: list[int]) -> str:
    """Lengths as COCO's text, written from `rleToString` of its description."""
    text = ""
    for i, count in enumerate(counts):
        x = count - counts[i - 2] if i > 2 else count
        while True:
            bits, x = x & 31, x >> 5
            more = x != (-1 if bits & 16 else 0)
            text += chr(48 + bits + 32 * more)
            if not more:
                break
    return text


def objects(labels: np.ndarray) -> list[int]:
    return [k for k in np.unique(labels).tolist() if k > 0]


def coco(folder: Path, labels: Labels, names: Names, form: str = "polygons") -> Path:
    images, annotations = [], []
    for i, (stem, image) in enumerate(labels.items(), 7):
        height, width = image.shape
        images.append({"id": i, "file_name": f"images/{stem}.jpg", "width": width, "height": height})
        for k in objects(image):
            counts = runs(image == k)
            segmentation = {
                "polygons": [np.ravel(corners(box)).tolist() for box in rectangles(image == k)],
                "runs": {"size": [height, width], "counts": counts},
                "text": {"size": [height, width], "counts": compressed(counts)},
            }[form]
            entry = {"id": len(annotations), "image_id": i, "category_id": k, "segmentation": segmentation}
            annotations.append({**entry, "iscrowd": 0, "bbox": [0, 0, 1, 1], "area": 1.0})
    categories = [{"id": k, "name": name} for k, name in names.items() if k]
    path = folder / "annotations.json"
    path.write_text(json.dumps({"images": images, "annotations": annotations, "categories": categories}))
    return path


def coco_runs(folder: Path, labels: Labels, names: Names) -> Path:
    return coco(folder, labels, names, "runs")


def coco_text(folder: Path, labels: Labels, names: Names) -> Path:
    return coco(folder, labels, names, "text")


def sam_json(folder: Path, labels: Labels, names: Names) -> Path:
    for stem, image in labels.items():
        masks = [
            {
                "segmentation": {"size": list(image.shape), "counts": compressed(runs(image == k))},
                "area": int((image == k).sum()), "bbox": [0, 0, 1, 1], "predicted_iou": 0.97,
                "point_coords": [[1.0, 2.0]], "stability_score": 0.98, "crop_box": [0, 0, *image.shape],
            }
            for k in objects(image)
        ]  # fmt: skip
        (folder / f"{stem}.json").write_text(json.dumps(masks))
    return folder


def sam_folders(folder: Path, labels: Labels, names: Names) -> Path:
    for stem, image in labels.items():
        (folder / stem).mkdir()
        rows = [AMG_HEADER]
        for i, k in enumerate(objects(image)):
            Image.fromarray(np.uint8(255 * (image == k))).save(folder / stem / f"{i}.png")
            rows.append(f"{i},{int((image == k).sum())},0,0,1,1,1.0,2.0,0.97,0.98,0,0,9,9")
        (folder / stem / "metadata.csv").write_text("\n".join(rows))
    return folder


def sam2_video(folder: Path, labels: Labels, names: Names) -> Path:
    for stem, image in labels.items():
        for k in objects(image):
            (folder / f"{k:03d}").mkdir(exist_ok=True)
            mask = Image.fromarray(np.uint8(image == k), "L").convert("P")
            mask.putpalette([0, 0, 0, 128, 0, 0])
            mask.save(folder / f"{k:03d}" / f"{stem}.png")
    return folder


def labelme(folder: Path, labels: Labels, names: Names) -> Path:
    for stem, image in labels.items():
        shapes = [
            {"label": names[k], "points": corners(box), "group_id": None, "shape_type": "polygon", "flags": {}}
            for k in objects(image)
            for box in rectangles(image == k)
        ]
        size = {"imageHeight": image.shape[0], "imageWidth": image.shape[1]}
        whole = {"version": "5.5.0", "flags": {}, "shapes": shapes, "imagePath": f"{stem}.jpg", "imageData": None}
        (folder / f"{stem}.json").write_text(json.dumps({**whole, **size}))
    return folder


def png_text(inside: np.ndarray) -> str:
    """A mask as a PNG in base64."""
    file = io.BytesIO()
    Image.fromarray(np.uint8(255 * inside)).save(file, "PNG")
    return base64.b64encode(file.getvalue()).decode()


def labelme_masks(folder: Path, labels: Labels, names: Names) -> Path:
    for stem, image in labels.items():
        shapes = []
        for k in objects(image):
            left, top, inside = cropped(image == k)
            ends = [[left, top], [left + inside.shape[1] - 1.0, top + inside.shape[0] - 1.0]]
            shapes.append({"label": names[k], "points": ends, "shape_type": "mask", "mask": png_text(inside)})
        size = {"imageHeight": image.shape[0], "imageWidth": image.shape[1]}
        (folder / f"{stem}.json").write_text(json.dumps({"shapes": shapes, "imagePath": f"{stem}.jpg", **size}))
    return folder


def isat(folder: Path, labels: Labels, names: Names) -> Path:
    for stem, image in labels.items():
        entries = [
            {"category": names[k], "group": 1, "segmentation": corners(box), "area": 1.0, "layer": 1.0, "bbox": [0] * 4}
            for k in objects(image)
            for box in rectangles(image == k)
        ]
        info = {"name": f"{stem}.jpg", "width": image.shape[1], "height": image.shape[0], "depth": 3, "note": ""}
        (folder / f"{stem}.json").write_text(json.dumps({"info": info, "objects": entries}))
    return folder


def grounded_sam(folder: Path, labels: Labels, names: Names) -> Path:
    for stem, image in labels.items():
        height, width = image.shape
        annotations = [
            {
                "class_name": names[k], "bbox": [0.0, 0.0, 1.0, 1.0], "score": [0.5],
                "segmentation": {"size": [height, width], "counts": compressed(runs(image == k))},
            }
            for k in objects(image)
        ]  # fmt: skip
        whole = {"image_path": f"images/{stem}.jpg", "annotations": annotations, "box_format": "xyxy"}
        (folder / f"{stem}.json").write_text(json.dumps(whole | {"img_width": width, "img_height": height}))
    return folder


def cvat(folder: Path, labels: Labels, names: Names, as_masks: bool = False) -> Path:
    lines = [
        '<?xml version="1.0" encoding="utf-8"?>',
        "<annotations>",
        "<version>1.1</version>",
        "<meta><task><labels>",
    ]
    lines += [f"<label><name>{name}</name></label>" for k, name in names.items() if k]
    lines += ["</labels></task></meta>"]
    for i, (stem, image) in enumerate(labels.items()):
        height, width = image.shape
        lines.append(f'<image id="{i}" name="{stem}.jpg" width="{width}" height="{height}">')
        for k in objects(image):
            label = f'label={quoteattr(names[k])} source="manual" occluded="0"'
            for box in [] if as_masks else rectangles(image == k):
                points = ";".join(f"{x:.2f},{y:.2f}" for x, y in corners(box))
                lines.append(f'<polygon {label} points="{points}" z_order="0"></polygon>')
            if as_masks:
                left, top, inside = cropped(image == k)
                counts = ", ".join(map(str, runs(inside, "C")))
                place = f'left="{left}" top="{top}" width="{inside.shape[1]}" height="{inside.shape[0]}"'
                lines.append(f'<mask {label} rle="{counts}" {place} z_order="0"></mask>')
        lines.append("</image>")
    path = folder / "annotations.xml"
    path.write_text("\n".join([*lines, "</annotations>"]))
    return path


def cvat_masks(folder: Path, labels: Labels, names: Names) -> Path:
    return cvat(folder, labels, names, as_masks=True)


def yolo(folder: Path, labels: Labels, names: Names) -> Path:
    (folder / "labels").mkdir()
    for stem, image in labels.items():
        height, width = image.shape
        lines = [
            f"{k - 1} " + " ".join(f"{x / width:.6f} {y / height:.6f}" for x, y in corners(box))
            for k in objects(image)
            for box in rectangles(image == k)
        ]
        (folder / "labels" / f"{stem}.txt").write_text("\n".join(lines) + "\n")
    (folder / "data.yaml").write_text(json.dumps({"names": [names[k] for k in sorted(names) if k]}))  # JSON is YAML.
    return folder / "labels"


def eiseg(folder: Path, labels: Labels, names: Names) -> Path:
    for stem, image in labels.items():
        Image.fromarray(np.uint8(image)).save(folder / f"{stem}.png")
        Image.fromarray(np.zeros((*image.shape, 3), np.uint8)).save(folder / f"{stem}_pseudo.png")
    lines = [f"{k} {name} 255 0 {k} " for k, name in names.items() if k]
    (folder / "autosave_label.txt").write_text("\n".join(lines) + "\n")
    return folder


def eiseg_polygons(folder: Path, labels: Labels, names: Names) -> Path:
    for stem, image in labels.items():
        polygons = [
            {"name": names[k], "labelIdx": k, "color": [255, 0, k], "points": corners(box)}
            for k in objects(image)
            for box in rectangles(image == k)
        ]
        (folder / f"{stem}.json").write_text(json.dumps(polygons))
    return folder


def object_masks(folder: Path, labels: Labels, names: Names) -> Path:
    """Label images as DEVA and Gaussian Grouping write them."""
    for stem, image in labels.items():
        Image.fromarray(np.uint8(image)).save(folder / f"{stem}.png")
    return folder


def palette_images(folder: Path, labels: Labels, names: Names) -> Path:
    """Label images with a palette, as SAM 2 and DAVIS write them."""
    for stem, image in labels.items():
        mask = Image.fromarray(np.uint8(image), "P")
        mask.putpalette([min(c * 9, 255) for c in range(3 * 20)])
        mask.save(folder / f"{stem}.png")
    return folder


WRITERS: dict[str, Writer] = {
    "COCO polygons": coco, "COCO runs": coco_runs, "COCO text": coco_text, "SAM 2 video": sam2_video,
    "LabelMe polygons": labelme, "LabelMe masks": labelme_masks, "ISAT": isat, "CVAT polygons": cvat,
    "CVAT masks": cvat_masks, "YOLO": yolo, "EISeg images": eiseg, "EISeg polygons": eiseg_polygons,
    "Gaussian Grouping": object_masks, "SAM 2 palette": palette_images, "Grounded SAM 2": grounded_sam,
}  # fmt: skip
PER_VIEW_WRITERS: dict[str, Writer] = {"SAM JSON": sam_json, "SAM folders": sam_folders}
NAMELESS = ("SAM 2 video", "Gaussian Grouping", "SAM 2 palette")
