"""Proves that a signal is noticed while the program waits for events, whichever thread the system gave it to.

What a first and a second signal do is in test_cli, with real processes.
"""

import signal
import threading
from queue import SimpleQueue

from splatmill.cli.display import follow


def test_a_signal_that_another_thread_receives_is_noticed() -> None:
    """Then the main thread's wait does not end by itself, as when a signal comes just before it begins."""
    inbox: SimpleQueue[follow.Item] = SimpleQueue()
    after = threading.Timer(40 * follow.SIGNAL_SECONDS, lambda: inbox.put(follow.EventsEnded()))
    with follow._signals_into(inbox):
        threading.Timer(0.2, lambda: signal.pthread_kill(threading.get_ident(), signal.SIGINT)).start()
        after.start()
        item = follow._next(inbox)
    after.cancel()
    assert isinstance(item, follow.Interruption)
