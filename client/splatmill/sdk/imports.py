"""Files that the server fetches from an address: `AsyncClient.imports` and `Client.imports`."""

import asyncio

from splatmill.errors import Refused, valid_request
from splatmill.schema import Capture, CreateImport, Import, ImportList, Progress, Role
from splatmill.transfer.connection import Connection, read_answer
from splatmill.transfer.uploads import OnProgress

_POLL_SECONDS = 0.5
_LONGEST_POLL = 5.0


class AsyncImports:
    """Lets the server fetch files of a capture, and reports how far they are."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    async def start(
        self,
        url: str,
        *,
        capture: str | None = None,
        role: Role | str = Role.images,
        name: str | None = None,
        sha256: str | None = None,
    ) -> Import:
        """Let the server fetch a file of a capture from an address, in the background.

        url: public address of the file, http:// or https://.
        capture: id of the capture; left out, a new one, whose id is that of the returned import.
        role: its purpose in the capture.
        name: its name there; left out, the last part of the address.
        sha256: SHA-256 of its bytes in hex, checked if given.

        Raises NotFound, and InvalidRequest for an address that the server does not use.
        """
        body = {"url": url, "role": role, "name": name, "sha256": sha256}
        request = valid_request(CreateImport, body)
        target = capture or await self._new_capture(url)
        try:
            response = await self._connection.request(
                "POST",
                f"/v1/captures/{target}/import",
                json=request.model_dump(mode="json", exclude_none=True),
            )
        except Refused:
            if capture is None:
                await self._connection.request("DELETE", f"/v1/captures/{target}")
            raise
        return read_answer(Import, response)

    async def _new_capture(self, url: str) -> str:
        body = {"name": url.partition("?")[0].rstrip("/").rsplit("/", 1)[-1][:200] or None}
        response = await self._connection.request("POST", "/v1/captures", json=body)
        return read_answer(Capture, response).id

    async def get(self, capture: str, import_id: str) -> Import:
        """Return an import: its state, the bytes received, and at the end the file or the problem."""
        path = f"/v1/captures/{capture}/imports/{import_id}"
        return read_answer(Import, await self._connection.request("GET", path))

    async def wait(
        self,
        capture: str,
        import_id: str,
        on_progress: OnProgress | None = None,
    ) -> Import:
        """Wait for the end of an import and return it, also where it has failed.

        on_progress: called with the bytes received.
        """
        pause = _POLL_SECONDS
        while True:
            record = await self.get(capture, import_id)
            if on_progress is not None:
                done = record.file.size if record.file is not None else record.received
                on_progress(Progress(stage="uploading", done=done, total=record.size, note=record.name))
            if record.state.final:
                return record
            await asyncio.sleep(pause)
            pause = min(pause * 1.5, _LONGEST_POLL)

    async def list(self, capture: str) -> list[Import]:
        """Return the imports of a capture, newest first."""
        response = await self._connection.request("GET", f"/v1/captures/{capture}/imports")
        return read_answer(ImportList, response).imports
