"""All records in storage and how jobs use them, at one moment."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from splatmill.schema import StoredKind
from splatmill_server.space.holdings import Holding
from splatmill_server.space.job_uses import JobUse


@dataclass(frozen=True)
class Snapshot:
    """All records in storage and how jobs use them.

    holdings: by key.
    jobs: what jobs use, by the id of the job.
    needed: the id of an unfinished job by the key of each record that it needs.
    last_used: seconds since 1970 by the key of the record.
    """

    holdings: Mapping[str, Holding]
    jobs: Mapping[str, JobUse]
    needed: Mapping[str, str] = field(default_factory=dict)
    last_used: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, holdings: Iterable[Holding], jobs: Mapping[str, JobUse]) -> "Snapshot":
        """Return the snapshot of these records and jobs."""
        held = {holding.key: holding for holding in holdings}
        needed: dict[str, str] = {}
        last_used = {key: holding.modified for key, holding in held.items()}
        for use in jobs.values():
            for key in use.records:
                last_used[key] = max(last_used.get(key, 0.0), use.last_heard)
                if use.unfinished:
                    needed[key] = use.id
        for holding in held.values():
            if holding.kind is StoredKind.model and holding.capture is not None:
                key = Holding(kind=StoredKind.capture, id=holding.capture).key
                last_used[key] = max(last_used.get(key, 0.0), holding.modified)
        return cls(held, jobs, needed, last_used)
