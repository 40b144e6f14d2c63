"""The best of up to three mappings of the same view graph, and one that more pairs add photos to."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

from splatmill_worker.colmap import pycolmap
from splatmill_worker.sfm.features import photo_index
from splatmill_worker.sfm.mapping import mapper
from splatmill_worker.sfm.matching import pairs
from splatmill_worker.sfm.run import SfmRun

ENOUGH_REGISTERED = 0.9
"""Share of the photos that the view graph connects, reliably registered, from which no other mapper is tried."""


SEPARATE = 0.01
"""Share of the photos that the view graph connects, left in separate models when clusters were joined, above which they
are mapped in one piece as well (decisions: clusters)."""


def registered_counts(mapped: mapper.Mapped | None) -> tuple[int, int]:
    """Number of photos registered reliably in the largest model, and number of all those registered in it."""
    if mapped is None:
        return 0, 0
    return len(mapped.reliable), mapped.registered


def best_mapping(
    run: SfmRun,
    database: Path,
    verified: Collection[pairs.Pair],
    cluster_models: Sequence[pycolmap.Reconstruction] = (),
) -> mapper.Mapped:
    """The best of up to three mappings: with the incremental mapper, with the global one, and with relaxed settings.

    Before them, `cluster_models` are joined, where there are any. That is enough only where at most SEPARATE of the
    photos that are connected are left in models of their own: one mapping may place them with the others.

    The global one is the first where `mapper` asks for it, and where it registered more photos at an earlier effort
    (decisions: first-mapper).

    No mapper registers photos that the view graph does not connect, so the next one is not tried where the last
    registered ENOUGH_REGISTERED of the photos that are connected.

    database: COLMAP's, with the two-view geometries of the `verified` pairs.
    """
    asked = run.options.mapper
    connected = set(pairs.connected_components(run.count, verified)[0])
    first: mapper.Mapper = "incremental"
    if asked != "auto":
        first = asked
    elif run.best_mapper is not None:
        first = run.best_mapper
    trials: list[tuple[mapper.Mapper, bool]] = [(first, False)]
    if cluster_models:
        trials.insert(0, ("incremental", False))
    if asked == "auto":
        trials.append(("global" if first == "incremental" else "incremental", False))
    if asked != "global":
        trials.append(("incremental", True))
    best: mapper.Mapped | None = None
    best_rank = 0, 0
    with run.clock("mapping"):
        for number, (name, relaxed) in enumerate(trials):
            mapped = mapper.run(
                name,
                database,
                run.count,
                run.threads,
                run.options.seed,
                relaxed=relaxed,
                cluster_models=cluster_models if number == 0 else (),
                on_progress=run.on_mapping,
                on_model=run.show,
                cancelled=run.cancelled,
            )
            rank = registered_counts(mapped)
            if best is None or rank > best_rank:
                best, best_rank = mapped, rank
            separate = len(connected & _separate(mapped)) if cluster_models and number == 0 else 0
            if best_rank[0] >= ENOUGH_REGISTERED * len(connected) and separate <= SEPARATE * len(connected):
                break
    assert best is not None  # there is at least one trial
    run.best_mapper = best.mapper
    return best


def _separate(mapped: mapper.Mapped) -> set[int]:
    """Indices of the photos that other models than the largest have placed alone."""
    first, *others = ({photo_index(m.images[i].name) for i in m.reg_image_ids()} for m in mapped.models)
    return set().union(*others) - first


def extended_mapping(run: SfmRun, database: Path, mapped: mapper.Mapped) -> mapper.Mapped:
    """`mapped` with the photos that more pairs in COLMAP's database, which it was made from, let it place."""
    with run.clock("mapping"):
        return mapper.extend(
            mapped,
            database,
            run.count,
            run.threads,
            run.options.seed,
            on_progress=run.on_mapping,
            on_model=run.show,
            cancelled=run.cancelled,
        )
