"""What must work again after a fault, and how soon: answers, new work, views, and each job that was interrupted."""

import time
from collections.abc import Callable

import httpx

from _soak import attempts
from _soak.clients import CAMERA, FINAL, Clients
from _soak.orphans import command
from _soak.service import Service

RESUME_SECONDS = 30.0
"""Seconds after a fault within which all of it works again, times the patience of the soak. Those in which the worker
trained other jobs do not count for a job that waits for it, up to twice as many: no job is passed over for ever."""

_PAUSE = 0.02  # seconds between two looks

MEASURED = ("answers", "accepts", "shows", "resumes")
"""What is measured, in seconds from the end of the fault:

answers: `/readyz` finds Redis, storage and the renderer;
accepts: a capture is made;
shows: the renderer has made a picture of the newest model, if there is one;
resumes: every job that had begun before the fault has got on or has ended. Where none had, any job has.
"""


def recover(
    service: Service, clients: Clients, struck: float, healed: float
) -> tuple[dict[str, float], str | None]:
    """Wait until all works again; return the seconds by what is measured, and a sentence about what does not work.

    struck, healed: monotonic times of the fault's beginning and end.
    """
    within = RESUME_SECONDS * service.patience
    seconds: dict[str, float] = {}
    waited: dict[str, Callable[[], bool | float]] = {
        "answers": service.ready,
        "accepts": lambda: accepts(service, clients),
        "shows": lambda: shows(service, clients),
        "resumes": lambda: resumed(service, clients, struck, healed),
    }
    limits = dict.fromkeys(waited, within)
    while len(seconds) < len(waited) and time.monotonic() < healed + max(limits.values()):
        for what in [what for what in waited if what not in seconds]:
            if (when := waited[what]()) is not False:
                seconds[what] = (time.monotonic() if when is True else when) - healed
        if "resumes" not in seconds and time.monotonic() >= healed + within - 1.0:
            waiting = missing(service, clients, struck, healed)
            others = attempts.busy_with_others(service.records(), healed, waiting)
            limits["resumes"] = within + min(others, 2.0 * within)
        time.sleep(_PAUSE)
    orphans = service.orphans()
    while orphans and time.monotonic() < healed + within:
        time.sleep(_PAUSE)
        orphans = service.orphans()
    late = [what for what, limit in limits.items() if seconds.get(what, limit) >= limit]
    complaint = None
    if late:
        parts = ", ".join(f"{what} after {limits[what]:.0f} s" for what in late)
        complaint = f"The service does not do this: {parts}."
        if "resumes" in late:
            waiting = missing(service, clients, struck, healed)
            complaint += f" It has not resumed {sorted(waiting) or 'any job'}."
    elif orphans:
        complaint = f"These processes have lost their parent and run on: {[command(pid) for pid in orphans]}."
    return seconds, complaint


def accepts(service: Service, clients: Clients) -> bool:
    """Return whether the service makes a capture now, which must then not be lost."""
    try:
        answer = service.http.post("/v1/captures", json={}, timeout=5)
    except httpx.HTTPError:
        return False
    if answer.status_code == 201:
        clients.captures.append(str(answer.json()["id"]))
    return answer.status_code == 201


def shows(service: Service, clients: Clients) -> bool:
    """Return whether there is a picture of the newest model, or no model."""
    models = [promise.job for promise in list(clients.promises.values()) if promise.state == "succeeded"]
    if not models:
        return True
    try:
        answer = service.http.post(f"/v1/models/{models[-1]}/render", json={"camera": CAMERA}, timeout=5)
    except httpx.HTTPError:
        return False
    return answer.status_code == 200 and answer.content.startswith(b"\x89PNG")


def interrupted(service: Service, clients: Clients, struck: float) -> set[str]:
    """Return the jobs that had begun before the fault. One that failed and was restarted since waits as a new one."""
    restarted = {promise.job: promise.restarted_at for promise in list(clients.promises.values())}
    records = [line for line in service.records() if line["at"] > restarted.get(line["job"], 0.0)]
    return attempts.interrupted(records, struck, ())


def missing(service: Service, clients: Clients, struck: float, healed: float) -> set[str]:
    """Return the jobs that were interrupted, have not ended and have not got on."""
    ended = {promise.job for promise in list(clients.promises.values()) if promise.state in FINAL}
    return interrupted(service, clients, struck) - ended - attempts.got_on(service.records(), healed).keys()


def resumed(service: Service, clients: Clients, struck: float, healed: float) -> bool | float:
    """Return when the last of the interrupted jobs got on, on the monotonic clock; False as long as one has not.

    A job that has ended without another step, cancelled or stored before, counts from when it is seen: True.
    """
    on = attempts.got_on(service.records(), healed)
    if missing(service, clients, struck, healed):
        return False
    begun = [on[job] for job in interrupted(service, clients, struck) if job in on]
    if begun:
        return max(begun)
    known = {promise.job for promise in clients.unfinished()}
    return min(on.values()) if on else not known
