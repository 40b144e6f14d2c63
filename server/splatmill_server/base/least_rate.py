"""The least rate at which other servers must send what this one fetches: a slow one would hold a slot for hours."""

import asyncio
import time
from collections.abc import AsyncIterator

from splatmill.schema import format_bytes

SECONDS = 60.0
"""Seconds over which the rate is measured."""


class TooSlow(Exception):
    """The other server sends too slowly. The message is a sentence for the user."""


async def at_least(chunks: AsyncIterator[bytes], rate: int) -> AsyncIterator[bytes]:
    """Pass the bytes on. Raises TooSlow once fewer than `rate` bytes per second came in SECONDS of waiting for them.

    What the reader does with the bytes is not counted as waiting: the other server is not to blame for it.
    """
    needed, received, waited = rate * SECONDS, 0, 0.0
    while True:
        began = time.monotonic()
        try:
            async with asyncio.timeout(SECONDS - waited if rate else None):
                chunk = await anext(chunks)
        except TimeoutError:
            raise TooSlow(
                f"The other server sent {format_bytes(received)} in {SECONDS:.0f} seconds, and "
                f"{format_bytes(rate)} per second are the least (SPLATMILL_MIN_IMPORT_RATE)."
            ) from None
        except StopAsyncIteration:
            return
        waited += time.monotonic() - began
        received += len(chunk)
        if received >= needed:
            received, waited = 0, 0.0
        yield chunk
