"""The limits, times and defaults that the guides name are those of the program.

A sentence of a page is written here with the values from the code in it, and must be in the page. Does not prove what
the guides say in other words, nor that the program keeps to its constants: tests of each part do.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache
from typing import Any

import pytest

from splatmill.backplane import keys as redis_keys
from splatmill.backplane import memory
from splatmill.backplane.jobs import events
from splatmill.backplane.queue import entries, leases
from splatmill.backplane.storage import bucket, storage
from splatmill.schema import (
    MAX_PHOTO_PIXELS,
    MIN_PHOTO_SIDE,
    PHOTOS_PER_VALIDATION,
    CreateJob,
    TrainOptions,
)
from splatmill.transfer import chunked_uploads
from splatmill_server import webhooks
from splatmill_server.access import keys
from splatmill_server.background import deliveries, imports, kept, meshes, orbits, sweeper
from splatmill_server.base import lists as listing
from splatmill_server.base import outgoing, paging
from splatmill_server.base.settings import Settings
from splatmill_server.captures import records
from splatmill_server.jobs import estimate, restoring
from splatmill_server.jobs import records as jobs
from splatmill_server.routes.jobs import live as job_live
from splatmill_server.space import usage
from splatmill_server.up import supervisor
from splatmill_worker import memory as worker_memory
from splatmill_worker import settings
from splatmill_worker.images import guarded
from splatmill_worker.images.archives import archive
from splatmill_worker.images.video import video
from splatmill_worker.pipeline import live, time_lapse
from splatmill_worker.render_service import edit
from splatmill_worker.service import redis_patience, rq_worker
from splatmill_worker.service.attempts import mirror
from splatmill_worker.sfm import checks
from splatmill_worker.splat.plan import evaluated, photos
from splatmill_worker.splat.report import report
from splatmill_worker.splat.train import disagreement
from tests.support.paths import ROOT

WORDS = (
    "zero",
    "one",
    "two",
    "three",
    "four",
    "five",
    "six",
    "seven",
    "eight",
    "nine",
    "ten",
    "eleven",
    "twelve",
)
SCRIPTS = ROOT / "server" / "splatmill_server" / "web" / "page"


def word(number: float) -> str:
    """A small whole number in letters."""
    assert number == int(number)
    return WORDS[int(number)]


def share(value: float) -> str:
    """One over a whole number, as in `a tenth`."""
    return {10: "a tenth", 20: "a twentieth", 100: "a hundredth"}[round(1 / value)]


def default(name: str) -> Any:
    """The default of a setting of the API."""
    return Settings.model_fields[name].default


def bound(field: str, name: str) -> int:
    """A bound, ge or le, of a field of a new job."""
    return next(
        int(getattr(mark, name)) for mark in CreateJob.model_fields[field].metadata if hasattr(mark, name)
    )


def script(path: str, name: str) -> int:
    """A constant of the web page: a number, or one shifted to the left."""
    match = re.search(rf"\bconst {name} = (\d+)(?: << (\d+))?;", (SCRIPTS / path).read_text())
    assert match is not None
    return int(match[1]) << int(match[2] or 0)


def pauses() -> str:
    """The pauses of deliveries as the page writes them."""
    hours = [pause // 3600 for pause in deliveries.PAUSES[3:]]
    assert deliveries.PAUSES[:3] == (5, 300, 1800)
    return f"5 seconds, 5 minutes, 30 minutes, {', '.join(map(str, hours[:-1]))} and {hours[-1]} hours"


MIB, HOUR = 1 << 20, 3600

SENTENCES: list[tuple[str, Callable[[], str]]] = [
    ("serving", lambda: f"starts it again, up to {word(entries.MAX_RETRIES)} times"),
    ("serving", lambda: f"waits again after about {leases.LEASE + default('reaper_interval'):.0f} seconds"),
    ("serving", lambda: f"loses {word(leases.MAX_LOST)} workers in a row without a new checkpoint fails"),
    ("serving", lambda: f"For {leases.LEASE} seconds after its return, none is taken for lost"),
    (
        "serving",
        lambda: f"has {rq_worker.STOP_GRACE:.0f} seconds (`--stop-grace`; {supervisor._STOP_GRACE:.0f} under",
    ),
    ("serving", lambda: f"when it has run for {(settings.max_run_time() or 0) / HOUR:.0f} hours"),
    ("serving", lambda: f"more than {100 * worker_memory.SHARE:.0f}% of the memory of the machine"),
    ("serving", lambda: f"one waits {word(redis_patience.PATIENCE / 60)} minutes"),
    ("serving", lambda: f"in the queue again after {restoring.GRACE} seconds"),
    ("serving", lambda: f"before the last {default('min_free_bytes') // MIB} MiB are used"),
    ("serving", lambda: f"its last {settings.DISK_RESERVE // MIB} MiB are used (`SPLATMILL_DISK_RESERVE`)"),
    ("serving", lambda: f"At most {storage.SLOTS} requests of an API process"),
    ("serving", lambda: f"a block of {bucket.BLOCK // MIB} MiB"),
    ("serving", lambda: f"copying takes at most {share(mirror.CHECKPOINT_SHARE)} of the time"),
    (
        "serving",
        lambda: f"copy takes over {word(mirror.CHECKPOINT_SHARE * mirror.CHECKPOINT_INTERVAL)} seconds",
    ),
    ("serving", lambda: f"clients that follow events ({default('max_event_streams')})"),
    ("serving", lambda: f"one that ends {word(kept.MAX_ATTEMPTS)} times in the same part"),
    ("serving", lambda: f"more than {100 * memory.ALARM:.0f}% of its `maxmemory`"),
    ("serving", lambda: f"(from {bound('priority', 'ge')} to {bound('priority', 'le')}, by default 0)"),
    ("programming/webhooks", lambda: f"is sent again** after {pauses()}"),
    ("programming/webhooks", lambda: f"within {deliveries.ANSWER_SECONDS:.0f} seconds"),
    (
        "programming/webhooks",
        lambda: f"the first {deliveries.MAX_ANSWER} bytes of the answer, for {webhooks.KEPT_DAYS} days",
    ),
    ("programming/webhooks", lambda: f"After {word(len(deliveries.PAUSES) + 1)} failures of one delivery"),
    (
        "programming/webhooks",
        lambda: f"For {webhooks.GRACE.total_seconds() / HOUR:.0f} hours, requests carry signatures",
    ),
    ("programming/uploads", lambda: f"max-size={default('max_file_bytes')}, max-age={records.STALE_SECONDS}"),
    (
        "programming/uploads",
        lambda: f"is deleted** after {records.STALE_SECONDS // HOUR} hours without a byte",
    ),
    ("programming/uploads", lambda: f"is asked {word(imports.MAX_ATTEMPTS)} times"),
    ("programming/uploads", lambda: f"every redirect (at most {word(imports.MAX_REDIRECTS)})"),
    ("programming/uploads", lambda: "ports besides {}, {}, {} and {}".format(*sorted(outgoing.PORTS))),
    ("programming/uploads", lambda: f"send files over {chunked_uploads.PIECE // MIB} MB in pieces"),
    ("programming/uploads", lambda: f"blocks of {bucket.BLOCK // MIB} MB are kept as objects"),
    ("access", lambda: f"reads the keys again after {word(keys.CACHE_SECONDS)} seconds"),
    ("access", lambda: f"ends after {word(default('session_seconds') / HOUR)} hours"),
    (
        "storage",
        lambda: f"looks every {word(default('sweep_interval') / 60)} minutes (`SPLATMILL_SWEEP_INTERVAL`)",
    ),
    ("storage", lambda: f"deletes up to {sweeper.MOST} records at a time"),
    ("storage", lambda: f"Listings take at most {share(usage.SCAN_SHARE)} of the time"),
    (
        "programming/rest",
        lambda: (
            f"at most {orbits.Orbits.most_unfinished} wait, and a model keeps at most {orbits.Orbits.most_of_model}"
        ),
    ),
    (
        "programming/rest",
        lambda: (
            f"At most {meshes.Meshes.most_unfinished} of an owner wait, and a model keeps at most "
            f"{meshes.Meshes.most_of_model}"
        ),
    ),
    ("programming/rest", lambda: f"are kept apart, up to {events.BOUNDS[redis_keys.log]} each"),
    ("programming/rest", lambda: f"up to {word(estimate.ALIKE)} jobs that are most alike"),
    ("programming/rest", lambda: f"the newest entries first, {paging.DEFAULT_LIMIT} at a time"),
    ("programming/rest", lambda: f"at most {listing.SCANNED} records are read for one page"),
    ("programming/rest", lambda: f"`Idempotency-Key` within {word(jobs.IDEMPOTENCY_DAYS)} days make one job"),
    ("web", lambda: f"at most {time_lapse.MOST} and {time_lapse.MOST_BYTES // 10**6} MB"),
    ("web", lambda: f"take at most {share(time_lapse.SHARE)} of the training"),
    ("web", lambda: f"at most {live.MOST_GAUSSIANS:,} Gaussians"),
    ("web", lambda: f"comes every {word(live.INTERVAL)} seconds"),
    ("web", lambda: f"at most {100 * live.SHARE:.0f} % of the time that the job is watched"),
    ("web", lambda: f"stops making snapshots {job_live.WATCH_SECONDS:.0f} seconds after"),
    ("web", lambda: f"up to {edit.MOST_PHOTOS} held-out photos"),
    ("web", lambda: f"Files over {script('new/upload/one_file.js', 'PIECE') // MIB} MB go in pieces"),
    ("web", lambda: f"Up to {word(script('new/upload/sending.js', 'CONCURRENT'))} files are sent at once"),
    (
        "report",
        lambda: (
            f"at most {len(evaluated.EVALUATED_AT)} in a run, and {len(evaluated.SHORT_EVALUATED_AT)} in a short"
        ),
    ),
    ("report", lambda: f"together take at most {share(evaluated.SHARE)} of the training time"),
    (
        "report",
        lambda: (
            f"up to {word(evaluated.ALSO_EVALUATED)} of the training photos, at the last dot over "
            f"{evaluated.FINALLY_EVALUATED} to {2 * evaluated.FINALLY_EVALUATED - 1}"
        ),
    ),
    (
        "report",
        lambda: (
            f"one in {word(PHOTOS_PER_VALIDATION)} of the training photos is set aside, at most "
            f"{word(photos.MOST_VALIDATION)}"
        ),
    ),
    ("report", lambda: f"departs by {100 * photos.LIGHT_DEPARTS:.1f} % or more"),
    ("report", lambda: f"more than {report.MISFIT:.0f} dB under their median"),
    ("report", lambda: f"by {disagreement.WHOLLY_OFF_DB:.1f} dB or more"),
    (
        "report",
        lambda: (
            f"after {word(disagreement.VISITS)} steps on each photo or {word(10 * disagreement.LATEST)} tenths of "
            "the run"
        ),
    ),
    ("photographing", lambda: f"At most {TrainOptions().max_video_frames} frames are taken from it"),
    ("photographing", lambda: f"about {video.FEWEST} are taken"),
    ("photographing", lambda: f"more than {MAX_PHOTO_PIXELS // 10**6} million pixels is left out"),
    ("photographing", lambda: f"a side under {MIN_PHOTO_SIDE} pixels"),
    ("photographing", lambda: f"up to {word(guarded.MAX_VIDEO_SECONDS / HOUR)} hours long"),
    ("photographing", lambda: f"frames of up to {guarded.MAX_FRAME_PIXELS // 10**6} million pixels"),
    (
        "photographing",
        lambda: (
            f"hold up to {archive.MAX_ENTRIES:,} files, and with the frames of its videos "
            f"{settings.MAX_UNPACKED // (1 << 30)} GiB. A zip as a whole is compressed up to {archive.MAX_RATIO} to 1"
        ),
    ),
    (
        "photographing",
        lambda: (
            f"(in sets of up to {word(checks.SMALL_SET)}), or fewer than {100 * checks.MIN_SHARE:.0f} % (in larger "
            f"sets), could be placed, or fewer than {checks.MIN_POINTS} points"
        ),
    ),
    ("photographing", lambda: f"below {checks.MIN_TRIANGULATION_ANGLE} degrees the job fails"),
]
"""Pages of docs/, and what each says."""


@cache
def text(page: str) -> str:
    return " ".join((ROOT / "docs" / f"{page}.md").read_text().split())


@pytest.mark.parametrize(("page", "sentence"), SENTENCES, ids=range(len(SENTENCES)))
def test_the_figures_are_those_of_the_program(page: str, sentence: Callable[[], str]) -> None:
    assert sentence() in text(page)
