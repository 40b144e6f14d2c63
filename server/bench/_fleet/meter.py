"""What Redis says of itself before and after something: processor, commands, bytes, memory, connections."""

import time
from dataclasses import dataclass
from typing import Any

import redis

_TOP = 5
"""Number of commands that are named with their share of the time."""


@dataclass(frozen=True)
class Look:
    """What INFO says at one moment.

    at: on the monotonic clock, seconds.
    cpu: seconds of processor that Redis has used.
    commands: number of commands, those of scripts included.
    received, sent: bytes.
    memory: bytes of data and of buffers.
    connections: number of clients.
    by_command: calls and microseconds by name of command.
    """

    at: float
    cpu: float
    commands: int
    received: int
    sent: int
    memory: int
    connections: int
    by_command: dict[str, tuple[int, float]]


def look(connection: redis.Redis) -> Look:
    """Return what Redis says now."""
    info = connection.info("everything")
    stats = {
        name.removeprefix("cmdstat_"): said for name, said in info.items() if name.startswith("cmdstat_")
    }
    return Look(
        at=time.monotonic(),
        cpu=float(info["used_cpu_user"]) + float(info["used_cpu_sys"]),
        commands=int(info["total_commands_processed"]),
        received=int(info["total_net_input_bytes"]),
        sent=int(info["total_net_output_bytes"]),
        memory=int(info["used_memory"]),
        connections=int(info["connected_clients"]),
        by_command={name: (int(said["calls"]), float(said["usec"])) for name, said in stats.items()},
    )


def between(before: Look, after: Look) -> dict[str, Any]:
    """Return the fields of a row for what Redis did between two looks.

    redis_cpu: share of one core.
    commands, received, sent: a second.
    of_cpu: share of the processor time of Redis, for the commands that took most; a script counts beside the commands
        that it runs.
    """
    seconds = after.at - before.at
    spent = {
        name: usec - before.by_command.get(name, (0, 0.0))[1] for name, (_, usec) in after.by_command.items()
    }
    cpu = after.cpu - before.cpu
    top = sorted(spent.items(), key=lambda pair: -pair[1])[:_TOP]
    return {
        "redis_cpu": cpu / seconds,
        "commands": (after.commands - before.commands) / seconds,
        "received": (after.received - before.received) / seconds,
        "sent": (after.sent - before.sent) / seconds,
        "of_cpu": {name: round(usec / 1e6 / cpu, 3) for name, usec in top if cpu > 0},
    }


def calls(before: Look, after: Look, command: str) -> int:
    """Return how often a command was called between two looks."""
    return after.by_command.get(command, (0, 0.0))[0] - before.by_command.get(command, (0, 0.0))[0]
