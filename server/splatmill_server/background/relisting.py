"""Lists what Redis has lost of the lists while its data stayed: the last second before it was killed, and captures that
were made while it was away. Where all of the lists is lost, `splatmill_server.base.lists` makes them anew."""

import asyncio

import redis
import structlog
from starlette.concurrency import run_in_threadpool

from splatmill.backplane import keys, lists
from splatmill.backplane.storage import layout
from splatmill.backplane.storage.storage import Storage, StorageError
from splatmill_server.base.problems import ProblemError
from splatmill_server.captures.records import Captures
from splatmill_server.models import Models

log = structlog.get_logger()


class Relisting:
    """Compares storage with the lists when this process starts, whenever Redis was started anew, and when a capture
    may have been made and is not listed. Each takes a listing of storage, and a read for each record that is missing.

    interval: seconds between two looks whether there is a reason.
    """

    def __init__(
        self,
        connection: redis.Redis,
        storage: Storage,
        captures: Captures,
        models: Models,
        interval: float,
    ) -> None:
        self.connection = connection
        self.storage = storage
        self.captures = captures
        self.models = models
        self.interval = interval
        self._compared_with: object = None

    async def run(self) -> None:
        """Look until this task is cancelled, also after errors."""
        while True:
            try:
                await run_in_threadpool(self.look)
            except (redis.RedisError, StorageError, ProblemError) as error:
                log.debug("the lists cannot be compared with storage", error=str(error))
            except Exception:
                log.exception("the comparison of the lists with storage failed")
            await asyncio.sleep(self.interval)

    def look(self) -> int:
        """List what is missing if Redis may have lost it; return the number of records.

        Raises redis.RedisError and StorageError; the next look then compares again.
        """
        run_id = self.connection.info("server")["run_id"]
        if run_id == self._compared_with and not self.captures.unlisted:
            return 0
        if self.connection.get(keys.LISTED) != lists.VERSION:
            return 0  # they are made from storage
        self.captures.unlisted = False
        try:
            listed = self.captures.list_missing(self.storage.children(layout.captures()))
            names = [name for name in self.storage.children(layout.models()) if layout.is_id(name)]
            listed += self.models.list_missing(names)
        except BaseException:
            self.captures.unlisted = True
            raise
        self._compared_with = run_id
        if listed:
            log.warning("records that Redis had lost from its lists were listed again", records=listed)
        return listed
