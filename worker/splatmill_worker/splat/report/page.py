"""The report as one self-contained HTML page."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from splatmill.schema import format_bytes
from splatmill_worker.splat.evaluate import ViewScore
from splatmill_worker.splat.picture import data_uri
from splatmill_worker.splat.report.disagreeing import MarkedPhoto
from splatmill_worker.splat.train.disagreement import Disagreement

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.1rem; margin-top: 2rem; }
table { border-collapse: collapse; } td, th { padding: .2rem .8rem .2rem 0; text-align: left; vertical-align: top; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; }
img { max-width: 100%; height: auto; } .pairs { display: flex; flex-wrap: wrap; gap: 1rem 2rem; }
.pair { display: flex; gap: .5rem; } .pair figure { margin: 0; } .pair img { max-height: 20rem; display: block; }
.pair figcaption { width: 0; min-width: 100%; } figcaption, .dim { color: #666; font-size: .85rem; }
.warn { background: #fff4e0; padding: .5rem .8rem; border-left: 3px solid #d08a20; margin: .3rem 0; }
"""

COLOR_FITTED = (
    "Colours fitted: after the affine change of the rendered colours that is closest to the photo. Where this is far "
    "above the PSNR, the photo's exposure or white balance differs, and the shape is right."
)


SCORES = (
    ("psnr", "PSNR (dB)", ".2f"),
    ("psnr_color_fitted", "PSNR, colours fitted (dB)", ".2f"),
    ("ssim", "SSIM", ".4f"),
    ("lpips_vgg", "LPIPS, VGG-16", ".4f"),
    ("lpips_alex", "LPIPS, AlexNet", ".4f"),
)
"""Scores of a view in report.json, with their heads on the page and their format."""

OPEN_VERSIONS = ("splatmill", "backend", "instruction_set")
"""Versions of report.json that the page shows, too: it is given out by links to the model."""


@dataclass(frozen=True)
class ViewComparison:
    """A rendered view beside its photo.

    score: error of the view.
    rendered: colour [H, W, 3], 0 to 1.
    photo: uint8 [H, W, 3].
    """

    score: ViewScore
    rendered: Tensor
    photo: Tensor


@dataclass(frozen=True)
class Disagreeing:
    """The photos that disagree with the others.

    named: the photos of the table.
    marked: those that are shown.
    """

    named: Sequence[Disagreement]
    marked: Sequence[MarkedPhoto]


def render(
    report: dict[str, Any],
    warnings: Sequence[str],
    figure: Path,
    comparisons: Sequence[ViewComparison],
    disagreeing: Disagreeing,
    hidden: Sequence[MarkedPhoto] = (),
) -> str:
    """The page as text, with the picture `figure` of the curve and the pictures of `comparisons` embedded.

    warnings: those of the report and those about photos.
    hidden: photos with what never moves marked.
    """
    curve = base64.b64encode(figure.read_bytes()).decode()
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>",
        f"<title>Splatmill report</title><style>{STYLE}</style>",
        f"<h1>{_headline(report['result'])}</h1>",
        *(f"<p class=warn>{html.escape(warning)}</p>" for warning in warnings),
        f"<img alt='PSNR and SSIM against training seconds' src='data:image/png;base64,{curve}'>",
        "<h2>Time by stage</h2>",
        _table(["stage", "seconds"], [[name, f"{value:.1f}"] for name, value in report["seconds"].items()]),
        f"<p class=dim>Peak memory: {format_bytes(report['peak_memory'])}.</p>",
        "<h2>What was decided, and why</h2>",
        _plan(report["plan"]),
        *_frame(report["frame"]),
        "<h2>What was left out, and why</h2>",
        _table(
            ["", ""],
            [
                [row["what"].replace("_", " ") if "what" in row else row["photo"], row["why"]]
                for row in report["left_out"]
            ],
            2,
        ),
        "<h2>Worst views beside their photos</h2>",
        "<div class=pairs>",
        *(_comparison(comparison) for comparison in comparisons),
        "</div>",
        "<h2>Photos that disagree with the others</h2>",
        *_disagreeing(disagreeing),
        *(["<h2>What never moves, and is masked</h2>", *_marked(hidden)] if hidden else []),
        "<h2>All evaluated views</h2>",
        _views(report["views"]),
        f"<p class=dim>{COLOR_FITTED}</p>",
        f"<p class=dim>{html.escape(_footer(report))}</p></html>",
    ]
    return "\n".join(parts)


def _views(rows: Sequence[dict[str, Any]]) -> str:
    """A table of the evaluated views, with the scores that any of them has."""
    shown = [each for each in SCORES if any(row[each[0]] is not None for row in rows)]
    lines = [
        [
            row["name"],
            row["split"],
            *("" if row[name] is None else f"{row[name]:{form}}" for name, _, form in shown),
        ]
        for row in rows
    ]
    return _table(["photo", "split", *(head for _, head, _ in shown)], lines, 2)


def _disagreeing(photos: Disagreeing) -> list[str]:
    if not photos.named:
        return ["<p>None does.</p>"]
    rows = [
        [each.name, each.reason, f"{each.decibels:.1f}", f"{100 * each.share:.1f}"] for each in photos.named
    ]
    lines = [_table(["photo", "looks like", "worse by (dB)", "of its pixels (%)"], rows, 2)]
    return [*lines, *_marked(photos.marked)]


def _marked(photos: Sequence[MarkedPhoto]) -> list[str]:
    lines = ["<div class=pairs>"]
    for photo in photos:
        caption = html.escape(photo.caption)
        lines.append(
            f"<div class=pair><figure><img alt='photo' src='{data_uri(photo.picture, 480)}'>"
            f"<figcaption>{caption}</figcaption></figure></div>"
        )
    return [*lines, "</div>"]


def _headline(result: dict[str, Any]) -> str:
    counted = f"{result['gaussians']:,} Gaussians after {result['steps']:,} steps"
    if result["psnr"] is None:
        return f"{result['train_psnr']:.2f} dB on training photos, none were held out; {counted}"
    fitted = f"{result['psnr_color_fitted']:.2f} dB with colours fitted"
    others = [fitted, f"SSIM {result['ssim']:.3f}"]
    if result["lpips_vgg"] is not None:
        others.append(f"LPIPS {result['lpips_vgg']:.3f} by VGG-16 and {result['lpips_alex']:.3f} by AlexNet")
    return f"{result['psnr']:.2f} dB on held-out photos ({', '.join(others)}); {counted}"


def _plan(plan: dict[str, Any]) -> str:
    reasons = plan.get("reasons", {})
    rows = []
    for name, reason in reasons.items():
        value = plan["schedule"]["degree"] if name == "sh_degree" else plan.get(name, "")
        shown = "" if isinstance(value, dict) else "yes" if value is True else str(value)
        rows.append([name.replace("_", " "), shown, reason])
    return _table(["", "", ""], rows, 3)


def _frame(frame: dict[str, Any] | None) -> list[str]:
    if frame is None:
        return []
    return [
        "<h2>Coordinates of the model</h2>",
        _table(["", ""], list(map(list, frame["reasons"].items())), 2),
    ]


def _comparison(view: ViewComparison) -> str:
    name = html.escape(view.score.name)
    return (
        "<div class=pair>"
        f"<figure><img alt='rendered' src='{data_uri(view.rendered, 480)}'>"
        f"<figcaption>{name}: {view.score.psnr:.2f} dB ({view.score.psnr_color_fitted:.2f} dB with colours fitted), "
        f"SSIM {view.score.ssim:.3f}</figcaption></figure>"
        f"<figure><img alt='photo' src='{data_uri(view.photo, 480)}'><figcaption>photo</figcaption></figure></div>"
    )


def _table(heads: Sequence[str], rows: Sequence[Sequence[Any]], text_columns: int = 1) -> str:
    """A table whose first `text_columns` columns are text and whose other columns are numbers."""

    def cell(tag: str, column: int, value: Any) -> str:
        kind = "" if column < text_columns else " class=n"
        return f"<{tag}{kind}>{html.escape(str(value))}</{tag}>"

    head = "".join(cell("th", i, value) for i, value in enumerate(heads)) if any(heads) else ""
    body = "".join(
        "<tr>" + "".join(cell("td", i, value) for i, value in enumerate(row)) + "</tr>" for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"


def _ended(stopped: str) -> str:
    """Why training ended, as a sentence. `stopped` is a clause, or after a failure a sentence."""
    return stopped if stopped.endswith(".") else f"Training ended because {stopped}."


def _footer(report: dict[str, Any]) -> str:
    """What times depend on, as far as anybody may know it who has a link: report.json names the machine."""
    versions, cores = report["versions"], report["machine"]["cores"]
    named = [f"{name.replace('_', ' ')} {versions[name]}" for name in OPEN_VERSIONS if versions.get(name)]
    return f"{', '.join([*named, f'{cores} cores'])}. {_ended(report['result']['stopped'])}"
