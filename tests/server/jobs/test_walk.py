"""A random walk over the real job records: clients, workers and the reaper act in any order on a real Redis.

Checked after every step: what was final stays, at most one attempt waits, unfinished jobs are on the reaper's list.
Not proved here: real processes (test_reaper, tests/service), and the fold's rules one by one (test_fold).
"""

from pathlib import Path
from typing import Any, cast

import pytest
import redis
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, invariant, rule, run_state_machine_as_test
from rq.job import Job as QueueJob
from rq.job import JobStatus

from splatmill.backplane import keys
from splatmill.backplane.jobs import events, row
from splatmill.backplane.queue import entries, lines, queue
from splatmill.backplane.storage import layout
from splatmill.schema import CreateJob, Job, JobState, StateEvent
from splatmill_server.access.caller import KEYLESS
from splatmill_server.base.problems import ProblemError
from splatmill_server.base.settings import Settings
from splatmill_server.service import Service

pytestmark = pytest.mark.slow

PHASES = [JobState.preparing, JobState.sfm, JobState.training, JobState.exporting]
CAPTURE = "c" * 16


class Walk(RuleBasedStateMachine):
    """Jobs of one service. `ended` is what clients were told last about jobs that had ended."""

    service: Service
    jobs = Bundle("jobs")

    def __init__(self) -> None:
        super().__init__()
        self.service.redis.flushall()
        self.service.storage.put(layout.capture_record(CAPTURE), b"{}")
        self.known: set[str] = set()
        self.ended: dict[str, tuple[int, Job]] = {}

    @property
    def redis(self) -> redis.Redis:
        return self.service.redis

    def entry(self, job_id: str) -> QueueJob | None:
        job_row = row.read(self.redis, job_id)
        if job_row is None or queue.status(self.redis, job_id, job_row.generation).state == "absent":
            return None
        rq_id = entries.rq_id(job_id, job_row.generation)
        return QueueJob.fetch(rq_id, connection=self.redis, serializer=entries.SERIALIZER)

    @rule(target=jobs)
    def create(self) -> str:
        job, new = self.service.jobs.create(CreateJob(capture=CAPTURE), owner="default")
        assert new
        assert job.state is JobState.queued
        self.known.add(job.id)
        return job.id

    @rule(job_id=jobs, phase=st.sampled_from(PHASES), stale=st.booleans())
    def worker_says(self, job_id: str, phase: JobState, stale: bool) -> None:
        """A worker takes the job from the queue if it waits there, and says where it is; or an old one still talks."""
        entry, job_row = self.entry(job_id), row.read(self.redis, job_id)
        if entry is None or job_row is None:
            return
        if lines.withdraw(self.redis, entry.id):
            entry.set_status(JobStatus.STARTED)
            events.begin_attempt(self.redis, job_id)
        number = int(self.redis.get(keys.attempts(job_id)) or 0)
        if number:
            attempt = max(1, number - 1) if stale else number
            events.append(self.redis, job_id, job_row.generation, attempt, StateEvent(state=phase))

    @rule(job_id=jobs, how=st.sampled_from(["succeeded", "failed", "died", "silent", "stopped"]))
    def worker_ends(self, job_id: str, how: str) -> None:
        entry, job_row = self.entry(job_id), row.read(self.redis, job_id)
        if entry is None or job_row is None or entry.get_status() != JobStatus.STARTED:
            return
        if how in JobState.__members__:
            number = int(self.redis.get(keys.attempts(job_id)) or 0)
            events.append(self.redis, job_id, job_row.generation, number, StateEvent(state=JobState(how)))
        status = {"died": JobStatus.FAILED, "stopped": JobStatus.STOPPED}.get(how, JobStatus.FINISHED)
        entry.set_status(status)

    @rule(job_id=jobs)
    def queue_forgets(self, job_id: str) -> None:
        if (entry := self.entry(job_id)) is not None and entry.get_status() == JobStatus.QUEUED:
            entry.delete()

    @rule(job_id=jobs)
    def client_cancels(self, job_id: str) -> None:
        self.attempt(self.service.jobs.cancel, job_id, {"job_finished"})

    @rule(job_id=jobs)
    def client_restarts(self, job_id: str) -> None:
        job = self.attempt(
            lambda name: self.service.admission.restart(KEYLESS, name), job_id, {"job_running"}
        )
        if job is not None:
            assert job.state is JobState.queued
            self.ended.pop(job_id, None)

    @rule(job_id=jobs)
    def client_deletes(self, job_id: str) -> None:
        self.attempt(self.service.jobs.delete, job_id, {"job_running"})
        if job_id not in self.listed():
            self.known.discard(job_id)
            self.ended.pop(job_id, None)

    @rule()
    def reaper_ticks(self) -> None:
        self.service.reaper.tick()

    def attempt(self, action: Any, job_id: str, refusals: set[str]) -> Any:
        try:
            return action(job_id)
        except ProblemError as error:
            if error.problem.code not in (refusals if job_id in self.known else {"job_not_found"}):
                raise
            return None

    def listed(self) -> set[str]:
        return {key.decode() for key in cast(list[bytes], self.redis.zrange(keys.JOBS, 0, -1))}

    @invariant()
    def final_is_final(self) -> None:
        for job_id in self.known:
            job, job_row = self.service.jobs.get(job_id), row.read(self.redis, job_id)
            assert job_row is not None
            if job_id in self.ended:
                generation, told = self.ended[job_id]
                assert (job_row.generation, job) == (generation, told)
            elif job.state.final:
                self.ended[job_id] = (job_row.generation, job)

    @invariant()
    def at_most_one_attempt_waits(self) -> None:
        lines.sort(self.redis)
        waiting = [entry.decode() for entry in cast(list[bytes], self.redis.hkeys(keys.PLACES))]
        jobs = [entries.split_rq_id(rq_id)[0] for rq_id in waiting]
        assert len(jobs) == len(set(jobs))

    @invariant()
    def the_reaper_knows_every_unfinished_job(self) -> None:
        watched = {member.decode() for member in cast(set[bytes], self.redis.smembers(keys.ACTIVE))}
        unfinished = {i for i in self.known if not self.service.jobs.get(i).state.final}
        assert unfinished <= watched

    def teardown(self) -> None:
        """Left alone, the reaper brings every job to its end, or it waits in the queue, or a worker has it."""
        for _ in range(3):
            self.service.reaper.tick()
        for job_id in self.known:
            job, job_row = self.service.jobs.get(job_id), row.read(self.redis, job_id)
            assert job_row is not None
            standing = queue.status(self.redis, job_id, job_row.generation).state
            assert job.state.final or standing in ("waiting", "running"), (job, standing)
            if job_row.cancel_requested_at is not None:
                assert job.state.final or standing == "running"


@pytest.mark.usefixtures("connection")
def test_any_order_of_events_keeps_the_records_whole(redis_url: str, tmp_path: Path) -> None:
    service = Service.of(Settings(redis_url=redis_url, data=tmp_path))
    machine = type("RealWalk", (Walk,), {"service": service})
    limits = settings(
        max_examples=25, stateful_step_count=25, deadline=None, suppress_health_check=list(HealthCheck)
    )
    try:
        run_state_machine_as_test(machine, settings=limits)
    finally:
        service.redis.close()
