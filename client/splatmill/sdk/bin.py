"""The bin of a server: `AsyncClient.bin` and `Client.bin`. What is put there can be restored for a day."""

from splatmill.schema import BinKind, BinList, Binned
from splatmill.transfer.connection import Connection, read_answer


class AsyncBin:
    """Puts jobs with their models, and captures, into the bin of a server, lists and restores them.

    Lists do not show what is in the bin, links to its models open nothing, and its bytes still count. The server
    deletes it for good a day after it was put there.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    async def list(self) -> list[Binned]:
        """Return what is in the bin, the newest first."""
        return read_answer(BinList, await self._connection.request("GET", "/v1/bin")).entries

    async def put_job(self, job_id: str) -> Binned:
        """Put a job that has ended into the bin, with its model, which has the same id.

        Raises NotFound, and Conflict for a job that has not ended or whose model an unfinished job starts from.
        """
        return read_answer(Binned, await self._connection.request("PUT", _path(BinKind.job, job_id)))

    async def put_capture(self, capture_id: str) -> Binned:
        """Put a capture into the bin. Raises NotFound, and Conflict for one that an unfinished job uses."""
        return read_answer(Binned, await self._connection.request("PUT", _path(BinKind.capture, capture_id)))

    async def restore_job(self, job_id: str) -> None:
        """Restore a job and its model. Raises NotFound for one that is not in the bin."""
        await self._connection.request("DELETE", _path(BinKind.job, job_id))

    async def restore_capture(self, capture_id: str) -> None:
        """Restore a capture. Raises NotFound for one that is not in the bin."""
        await self._connection.request("DELETE", _path(BinKind.capture, capture_id))


def _path(kind: BinKind, record_id: str) -> str:
    return f"/v1/bin/{kind.value}s/{record_id}"
