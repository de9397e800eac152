"""`report.html`: what a run found, in one file that needs nothing else, for people.

The page fetches nothing: its Content-Security-Policy forbids that, and lets only the one script run whose hash it
names, so that a name with markup in it could not do harm even if it were not escaped.
"""

from __future__ import annotations

import base64
import hashlib
import os
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

import numpy as np

from gsseg_core.export.pictures import palette
from gsseg_core.files.atomic import write_atomically
from gsseg_core.report import sections as html
from gsseg_core.report.findings import Evidence, class_ious, mean_reliability, warnings_of
from gsseg_core.report.pictures import PICTURE_PX, THUMBNAIL_PX, ViewImages, draw_triple, jpeg_uri, thumbnails
from gsseg_core.report.preview import look_from, make_preview, up_of
from gsseg_core.scene.gaussian_scene import GaussianScene
from gsseg_core.segmentation import REMOVED, UNOBSERVED, Segmentation
from gsseg_core.text import html_text, percent

LOOKS = 8
"""Views from which the preview can be looked at."""

MOST_THUMBNAILS = 200
"""Classes with a picture, those with the most Gaussians: the page should stay small."""

_UNOBSERVED_COLOR, _REMOVED_COLOR = (128, 131, 138), (214, 64, 159)


def write_report_page(
    path: str | os.PathLike[str],
    report: Mapping[str, Any],
    scene: GaussianScene,
    segmentation: Segmentation,
    evidence: Evidence,
    images: ViewImages,
) -> None:
    """Write the page, atomically.

    Parameters
    ----------
    path : path
        Of `report.html`. Links to PLYs are relative to it.
    report : mapping
        What `report.json` holds.
    scene : GaussianScene
        What was segmented.
    segmentation : Segmentation
        What came out.
    evidence : Evidence
        Masks beside predictions of them.
    images : ViewImages
        What was seen.

    Raises
    ------
    WriteError
        The file cannot be written.
    """
    page = report_page(report, scene, segmentation, evidence, images)
    with write_atomically(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def report_page(
    report: Mapping[str, Any],
    scene: GaussianScene,
    segmentation: Segmentation,
    evidence: Evidence,
    images: ViewImages,
) -> str:
    """Put the page together; see `write_report_page`."""
    colors = palette(segmentation.num_classes)
    confusion = evidence.confusion(segmentation.num_classes) if evidence.checks else None
    ious = None if confusion is None else class_ious(confusion)
    sections = [
        ("In 3D", "preview", _preview(scene, segmentation, evidence, images, colors)),
        ("Masks beside predictions", "views-shown", _triples(evidence, images, colors, report)),
        ("Classes", "classes", _classes(report, evidence, images, colors, ious)),
        ("Confusion between classes", "confusion", _confusion(confusion, segmentation)),
        ("Views by reliability", "reliability", _reliability(report)),
        ("Confidence", "confidence", _confidence(segmentation)),
        ("Time", "time", html.timings(report["seconds"])),
        ("Settings and versions", "settings", _settings(report)),
    ]
    name = html_text(os.path.basename(report["scene"]["path"]))
    links = "".join(f'<a href="#{anchor}">{title}</a>' for title, anchor, body in sections if body)
    body = "".join(
        f'<section id="{anchor}"><h2>{title}</h2>{content}</section>' for title, anchor, content in sections if content
    )
    style, script = (files("gsseg_core.report").joinpath(f"page.{kind}").read_text("utf-8") for kind in ("css", "js"))
    policy = (
        f"default-src 'none'; img-src data:; style-src {_hash(style)}; script-src {_hash(script)}; "
        "base-uri 'none'; form-action 'none'"
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="gsseg-run" content="{html_text(report.get("run", ""))}">
<meta name="color-scheme" content="light dark">
<meta name="generator" content="gsseg {html_text(report["versions"]["gsseg"])}">
<link rel="icon" href="data:,">
<title>gsseg: {name}</title>
<style>{style}</style>
</head>
<body>
<header>
<p class="brand">gsseg</p><h1>{name}</h1><p class="faint">{html_text(report["scene"]["path"])}</p>
{html.cards(_figures(report, segmentation))}
</header>
{html.notices(warnings_of(report, ious))}
<nav aria-label="sections">{links}</nav>
<main>{body}</main>
<footer>Written by gsseg {html_text(report["versions"]["gsseg"])}. The figures are in report.json, too.</footer>
<script>{script}</script>
</body>
</html>
"""


def _figures(report: Mapping[str, Any], segmentation: Segmentation) -> list[tuple[str, str, str]]:
    gaussians, total = report["gaussians"], report["scene"]["gaussians"]
    found = sum(1 for entry in report["classes"] if entry["id"] and entry["gaussians"])
    views, reliability = report["views"], mean_reliability(report)
    labelled = segmentation.labels >= 0
    confidence = float(segmentation.confidence[labelled].mean()) if labelled.any() else None
    return [
        ("Objects", f"{found}", f"of {sum(1 for entry in report['classes'] if entry['id'])} classes"),
        ("Gaussians", f"{total:,}", f"{percent(gaussians['labelled'] / max(total, 1))} labelled"),
        ("Mean confidence", percent(confidence), "of the labelled ones"),
        ("Views", f"{views['used']}", f"{sum(views['rejected'].values())} rejected"),
        ("Mean reliability", percent(None if np.isnan(reliability) else reliability), "of the masks"),
        ("Time", f"{sum(report['seconds'].values()):.1f} s", f"learner {report['settings']['learner']}"),
    ]


def _preview(
    scene: GaussianScene,
    segmentation: Segmentation,
    evidence: Evidence,
    images: ViewImages,
    colors: np.ndarray,  # (K, 3)
) -> str:
    preview = make_preview(scene, segmentation)
    # The more classes a view shows, the better it is to begin with.
    shown = [((check.counts.sum(axis=1) > 0).sum(), check.reliability, check) for check in evidence.checks]
    ranked = [check for *_, check in sorted(shown, key=lambda entry: (-entry[0], -np.nan_to_num(entry[1])))]
    cameras = [evidence.views[check.name].camera for check in ranked[:LOOKS]]
    num_classes = segmentation.num_classes
    data = {
        **preview.header(),
        "cameras": look_from(cameras, preview),
        "up": up_of(view.camera for view in evidence.views.values()),
        "colors": [*colors.tolist(), list(_UNOBSERVED_COLOR), list(_REMOVED_COLOR)],
        "hidden": [num_classes + 1],
    }
    others = [
        (num_classes + i, name, color, int((segmentation.labels == label).sum()))
        for i, (label, name, color) in enumerate(
            [(UNOBSERVED, "seen by no mask", _UNOBSERVED_COLOR), (REMOVED, "removed by the filter", _REMOVED_COLOR)]
        )
    ]
    legend = html.legend(
        segmentation.class_names, colors, segmentation.counts(), [other for other in others if other[3]]
    )
    poster = ""
    if ranked:
        picture = draw_triple(ranked[0], evidence.views[ranked[0].name], images, colors).prediction
        poster = f'<img class="poster" src="{jpeg_uri(picture, 640)}" alt="the scene, coloured by class">'
    options = "".join(f'<option value="{i}">view {html_text(camera.name)}</option>' for i, camera in enumerate(cameras))
    left_out = f"{len(preview.records):,} of {len(scene):,} Gaussians" if preview.left_out else "All Gaussians"
    return f"""<div class="viewer">
<div class="stage">{poster}
<canvas class="js-only" tabindex="0" role="img"
 aria-label="the scene in 3D; arrow keys turn it, plus and minus zoom"></canvas>
<p class="hint js-only">drag to turn, shift to move; click, then wheel to zoom</p></div>
<div class="panel">
<div class="controls js-only">
<div class="modes" role="group" aria-label="colour by">
<button type="button" data-mode="0" aria-pressed="true">class</button>
<button type="button" data-mode="1" aria-pressed="false">true colour</button>
<button type="button" data-mode="2" aria-pressed="false">confidence</button></div>
<label>look from <select class="looks">{options}<option value="-1">all of it, from outside</option></select></label>
<label>cut away <input type="range" class="cut" min="0" max="100" value="0"></label>
<p class="ramp" hidden><span>0</span><canvas width="128" height="1" aria-hidden="true"></canvas><span>1</span></p>
<p class="all"><button type="button" data-all="1">all</button><button type="button" data-all="0">none</button></p>
</div>
{legend}
</div></div>
<noscript><p class="faint">The preview in 3D needs JavaScript; everything else does without.</p></noscript>
<p class="faint">{left_out}, as opaque discs. <code>classes/</code> has every object as a PLY for any 3DGS viewer.</p>
<script type="application/json" id="preview-data">{html.embedded_json(data)}</script>
<script type="text/plain" id="preview-records">{preview.as_text()}</script>"""


def _triples(evidence: Evidence, images: ViewImages, colors: np.ndarray, report: Mapping[str, Any]) -> str:
    confusions = {view["name"]: view["confusions"] for view in report["views"].get("reliability", [])}
    source = "what the other views predict" if evidence.held_out else "what was learnt, from this view too"
    shown = []
    for what, check in evidence.examples():
        pictures = draw_triple(check, evidence.views[check.name], images, colors)
        captions = ("its mask", source, "red where the two differ")
        shown.append(
            html.triple(
                check.name,
                f"{what}: {percent(check.reliability)} the same",
                html.confusions_of(confusions.get(check.name, [])),
                [(name, jpeg_uri(image, PICTURE_PX)) for name, image in zip(captions, pictures, strict=True)],
            )
        )
    return "".join(shown)


def _classes(
    report: Mapping[str, Any], evidence: Evidence, images: ViewImages, colors: np.ndarray, ious: np.ndarray | None
) -> str:
    sizes = [entry["gaussians"] for entry in report["classes"]]
    largest = sorted(range(len(sizes)), key=lambda k: -sizes[k])[:MOST_THUMBNAILS]
    found = thumbnails(largest, evidence, images, colors)
    pictures = {k: (view, jpeg_uri(image, THUMBNAIL_PX)) for k, (view, image) in found.items()}
    views = evidence.views_showing(len(colors)) if evidence.checks else None
    source = "the other views predict" if evidence.held_out else "was learnt predicts"
    note = (
        f'<p class="faint">IoU: between each mask and what {source}, over {len(evidence.checks)} views. '
        "Where masks are wrong it is low, however good the objects are.</p>"
        if evidence.checks
        else ""
    )
    return note + html.class_table(report["classes"], colors, pictures, views, len(evidence.checks), ious)


def _confidence(segmentation: Segmentation) -> str:
    temperature = segmentation.temperature
    calibrated = f", calibrated at temperature {temperature:.2f}" if temperature != 1 else ""
    return (
        f'<p class="faint">Gaussians with a label, by the probability of their class{calibrated}.</p>'
        + html.confidence_chart(segmentation)
    )


def _confusion(confusion: np.ndarray | None, segmentation: Segmentation) -> str:
    return "" if confusion is None else html.confusion_section(confusion, segmentation.class_names)


def _reliability(report: Mapping[str, Any]) -> str:
    views = report["views"].get("reliability")
    if not views:
        return ""
    return (
        '<p class="faint">The share of a mask\'s pixels whose label is what all other views predict there. '
        "Not learnt from: pixels in regions of the mask that the votes of all other views speak against.</p>"
        + html.views_section(views)
    )


def _settings(report: Mapping[str, Any]) -> str:
    scene = {"scene digest": report["scene"]["digest"][:16]}
    found = {f"ids.{name}": report["ids"][name] for name in ("objects", "segments")} if "ids" in report else {}
    return (
        html.settings_list({**scene, **report["settings"], **found})
        + "<h3>Versions</h3>"
        + html.settings_list(report["versions"])
    )


def _hash(content: str) -> str:
    return "'sha256-" + base64.b64encode(hashlib.sha256(content.encode()).digest()).decode() + "'"
