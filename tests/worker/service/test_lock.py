"""Proves that at most one living process holds a job's lock, against a real Redis and real processes.

Does not run two machines: another machine's name is written into the lock instead.
"""

import os
import subprocess
import sys
from dataclasses import replace

import redis

from splatmill.backplane import keys
from splatmill.process import ProcessIdentity, start_time
from splatmill_worker.service.lock import STALE_MS, JobLock, LockState
from tests.support.waiting import wait_for

ME = ProcessIdentity.of(os.getpid())


def other() -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)


def test_a_living_holder_keeps_the_lock_however_silent(connection: redis.Redis) -> None:
    first, second = (JobLock(connection, "job00001", token) for token in "ab")
    assert first.take(ME, 1)
    connection.hincrby(keys.lock("job00001"), "seen", -100 * STALE_MS)
    assert not second.take(ME, 2)
    assert first.refresh() is LockState.held
    second.release()
    assert first.holder() is not None
    first.release()
    assert second.take(ME, 2)


def test_a_dead_holder_is_followed_at_once(connection: redis.Redis) -> None:
    process = other()
    identity = ProcessIdentity.of(process.pid)
    first, second = (JobLock(connection, "job00001", token) for token in "ab")
    assert first.take(identity, 1)
    assert not second.take(ME, 2)
    process.kill()
    # Not waited for yet: a zombie runs nothing and counts as dead.
    wait_for(identity.dead)
    assert second.take(ME, 2)
    assert first.refresh() is LockState.lost
    process.communicate()


def test_a_holder_out_of_sight_is_judged_by_its_silence(connection: redis.Redis) -> None:
    first, second = (JobLock(connection, "job00001", token) for token in "ab")
    assert first.take(replace(ME, machine="elsewhere"), 1)
    assert not second.take(ME, 2)
    connection.hincrby(keys.lock("job00001"), "seen", -STALE_MS - 1000)
    assert second.take(ME, 2)


def test_a_holder_from_before_the_last_boot_is_dead() -> None:
    assert replace(ME, boot="an earlier one").dead()
    assert not replace(ME, namespace="another container's").dead()
    assert not ME.dead()
    assert replace(ME, started="1").dead(), "the number was given to a new process"


def test_of_two_takers_one_gets_a_dead_holders_lock(connection: redis.Redis) -> None:
    process = other()
    dead = ProcessIdentity.of(process.pid)
    process.kill()
    process.communicate()
    assert start_time(process.pid) is None
    assert JobLock(connection, "job00001", "dead").take(dead, 1)
    second, third = (JobLock(connection, "job00001", token) for token in "bc")
    assert second.take(ME, 2)
    assert not third.take(ME, 3)
