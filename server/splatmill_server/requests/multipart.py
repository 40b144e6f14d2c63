"""A streaming parser of `multipart/form-data`: one part after the other, in pieces.

Starlette's form parser keeps a file open for each part, and a few hundred photos would exhaust the limit on these.
"""

from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Literal

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.requests import Request

from splatmill_server.base.problems import ProblemError, body_cut_off

_MAX_FIELD_BYTES = 1 << 20

PartEvent = Literal["headers", "data", "end"]


@dataclass
class Part:
    """A part of a form. `chunks` must be exhausted before the next part is requested."""

    name: str
    filename: str | None
    chunks: AsyncIterator[bytes]

    async def text(self) -> str:
        """Return the text of a field. Raises a 413 problem if it is too large, and a 400 problem if it is not UTF-8."""
        data = b""
        async for chunk in self.chunks:
            data += chunk
            if len(data) > _MAX_FIELD_BYTES:
                raise ProblemError(
                    "body_too_large",
                    f"The field {self.name!r} has more than {_MAX_FIELD_BYTES} bytes, the limit for a field.",
                )
        try:
            return data.decode()
        except UnicodeDecodeError as error:
            raise ProblemError("malformed_body", f"The field {self.name!r} is not UTF-8 text.") from error


async def read_parts(request: Request) -> AsyncIterator[Part]:
    """Yield the parts of a form in order. Raises 400 problems for a body that is malformed or incomplete."""
    events = _Events(request)
    while (event := await events.next()) is not None:
        kind, payload = event
        if kind != "headers":
            continue
        _, options = parse_options_header(payload)
        filename = options.get(b"filename")
        part = Part(
            name=options.get(b"name", b"").decode("utf-8", "replace"),
            filename=None if filename is None else filename.decode("utf-8", "replace"),
            chunks=_chunks(events),
        )
        yield part
        async for _ in part.chunks:
            pass
    if not events.complete:
        problem = body_cut_off()
        raise ProblemError(problem.code, problem.detail, advice=problem.advice)


async def _chunks(events: "_Events") -> AsyncIterator[bytes]:
    while (event := await events.next()) is not None:
        kind, payload = event
        if kind == "end":
            return
        yield payload
    problem = body_cut_off()
    raise ProblemError(problem.code, problem.detail, advice=problem.advice)


class _Events:
    """The events of the parser, which reports them through callbacks, as a sequence."""

    def __init__(self, request: Request) -> None:
        _, options = parse_options_header(request.headers.get("content-type", ""))
        boundary = options.get(b"boundary")
        if not boundary:
            raise ProblemError(
                "malformed_body",
                "The Content-Type of the multipart body has no boundary.",
                advice="Let the HTTP library set the Content-Type of the form.",
            )
        self._body = request.stream()
        self._parts: list[tuple[PartEvent, bytes]] = []
        self._header, self._value, self._disposition = b"", b"", b""
        self.complete = False
        try:
            self._parser = MultipartParser(
                boundary,
                {
                    "on_part_begin": self._on_part_begin,
                    "on_header_field": self._on_header_field,
                    "on_header_value": self._on_header_value,
                    "on_header_end": self._on_header_end,
                    "on_headers_finished": self._on_headers_finished,
                    "on_part_data": self._on_part_data,
                    "on_part_end": self._on_part_end,
                    "on_end": self._on_end,
                },
            )
        except FormParserError as error:
            raise ProblemError(
                "malformed_body", f"The boundary of the multipart body is not accepted: {error}."
            ) from error

    async def next(self) -> tuple[PartEvent, bytes] | None:
        """Return the next event, or None at the end of the body."""
        while not self._parts:
            chunk = await anext(self._body, None)
            if chunk is None:
                return None
            try:
                self._parser.write(chunk)
            except FormParserError as error:
                raise ProblemError(
                    "malformed_body", f"The multipart body is malformed: {error}.", advice="Send it again."
                ) from error
        return self._parts.pop(0)

    def _on_part_begin(self) -> None:
        self._disposition = b""

    def _on_header_field(self, data: bytes, start: int, end: int) -> None:
        self._header += data[start:end]

    def _on_header_value(self, data: bytes, start: int, end: int) -> None:
        self._value += data[start:end]

    def _on_header_end(self) -> None:
        if self._header.lower() == b"content-disposition":
            self._disposition = self._value
        self._header, self._value = b"", b""

    def _on_headers_finished(self) -> None:
        self._parts.append(("headers", self._disposition))

    def _on_part_data(self, data: bytes, start: int, end: int) -> None:
        self._parts.append(("data", data[start:end]))

    def _on_part_end(self) -> None:
        self._parts.append(("end", b""))

    def _on_end(self) -> None:
        self.complete = True
