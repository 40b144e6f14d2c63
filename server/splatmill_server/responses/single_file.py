"""A model and its viewer in one HTML file, to be mailed or kept: it needs no server and sends no request."""

import base64
import json
import re
from collections.abc import Iterator
from html import escape
from pathlib import Path, PurePosixPath

from splatmill.schema import ModelCameras, Presentation
from splatmill_server.base.problems import ProblemError

WEB = Path(__file__).parents[1] / "web"
"""Where the viewer lies: `page/viewer.js` with what it imports, and PlayCanvas in `vendor/`."""

WHOLE, IN_PARTS, MANY = "sog", "lod.zip", 2**18
"""Keys of the formats that the file holds: of a model of more than MANY Gaussians the one with levels of detail, of
which the viewer draws as many as a browser can. The page's are in `page/viewer/small_file.js`."""

MOST_CAMERAS = 400
"""Cameras that the file holds. They tell its viewer where up is and where to look."""

POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' data: blob:; style-src 'unsafe-inline'; img-src data: blob:; "
    "worker-src blob: data:; connect-src blob: data:"
)
"""What the file may load: nothing from anywhere but itself."""

_RELATIVE = re.compile(r'(\bfrom |\bimport\()"(\.{1,2}/[^"]+)"')

_STYLE = """
html, body { margin: 0; height: 100%; background: #000; color: #ddd; font: 16px/1.5 system-ui, sans-serif; }
#view { position: fixed; inset: 0; }
#view .view { touch-action: none; }
#view .view :is(.enter, .leave) { display: none; }
#said { position: fixed; inset: auto 0 0 0; margin: 0; padding: 0.5rem 1rem; background: #000a; }
#said:empty { display: none; }
"""

_START = """
import { open } from "splatmill/viewer.js";
import { present } from "splatmill/viewer/presented.js";
const text = (id) => document.getElementById(id).textContent;
const said = document.getElementById("said");
said.textContent = "The model is being unpacked.";
try {
  const letters = atob(text("model"));
  const bytes = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; i++) bytes[i] = letters.charCodeAt(i);
  const { presentation, ...options } = JSON.parse(text("options"));
  const box = document.getElementById("view");
  globalThis.view = await open(box, { bytes, ...options });
  present(box, view, presentation, options.label);
  said.textContent = "";
} catch (error) {
  said.textContent = `The model cannot be shown: ${error.message}`;
}
"""


def held_format(gaussians: int) -> str:
    """The key of the format in which the file holds a model of so many Gaussians."""
    return IN_PARTS if gaussians > MANY else WHOLE


def single_file(
    name: str,
    packed: bytes,
    cameras: ModelCameras,
    antialias: bool,
    presentation: Presentation | None = None,
    poster: bytes | None = None,
    *,
    levels: bool = False,
) -> bytes:
    """Return the HTML file of a model.

    name: the title.
    packed: the model as a `.sog`, the smallest format that the viewer draws, or with `levels` as a `.lod.zip`.
    cameras: those of its photos, whose names are left out.
    antialias: whether the model was trained with antialiasing.
    presentation: how its owner wants it to be shown; None: as ever.
    poster: the picture from its start view, a JPEG.

    Raises a problem where the server was installed without PlayCanvas.
    """
    specs = [camera.camera.model_dump(mode="json", exclude_none=True) for camera in cameras.cameras]
    shown = presentation or Presentation()
    view = shown.start_view
    options = {
        "cameras": specs[:: len(specs) // MOST_CAMERAS + 1],
        "up": cameras.up,
        "antialias": antialias,
        "label": name,
        "levels": levels,
        "background": shown.background,
        "presentation": shown.model_dump(mode="json", exclude={"start_view"}),
        **({"camera": view.model_dump(mode="json", exclude_none=True)} if view else {}),
        **({"poster": _data(poster, "image/jpeg")} if view and poster else {}),
    }
    # Within a script element, "<" could end it.
    options_text = json.dumps(options).replace("<", "\\u003c")
    license_text = _vendor("playcanvas/LICENSE").replace("--", "- -")
    imports = {module: _data(source.encode()) for module, source in _modules()}
    imports["playcanvas"] = _data(_vendor("playcanvas/playcanvas.mjs").encode())
    return "\n".join(
        (
            "<!doctype html>",
            f"<!-- A model made by Splatmill, with its viewer. It contains PlayCanvas:\n{license_text}\n-->",
            '<html lang="en"><head><meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{escape(POLICY)}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(name)}</title>",
            f"<style>{_STYLE}{(WEB / 'page/viewer.css').read_text()}</style>",
            f'<script type="importmap">{json.dumps({"imports": imports})}</script></head>',
            '<body><div id="view"></div><p id="said" role="status"></p>',
            f'<script type="application/json" id="options">{options_text}</script>',
            f'<script type="text/plain" id="model">{base64.b64encode(packed).decode()}</script>',
            f'<script type="module">{_START}</script></body></html>',
            "",
        )
    ).encode()


def _modules() -> Iterator[tuple[str, str]]:
    """The viewer's modules, each with its name and source. They import each other by these names, because relative
    addresses mean nothing between modules that have no address."""
    pending, visited = [PurePosixPath("viewer.js"), PurePosixPath("viewer/presented.js")], set()
    while pending:
        path = pending.pop()
        if path in visited:
            continue
        visited.add(path)

        def named(match: re.Match[str], folder: PurePosixPath = path.parent) -> str:
            other = _resolved(folder, match[2])
            pending.append(other)
            return f'{match[1]}"splatmill/{other}"'

        yield f"splatmill/{path}", _RELATIVE.sub(named, (WEB / "page" / path).read_text())


def _resolved(folder: PurePosixPath, address: str) -> PurePosixPath:
    parts = [*folder.parts]
    for part in address.split("/"):
        if part == "..":
            parts.pop()
        elif part != ".":
            parts.append(part)
    return PurePosixPath(*parts)


def _vendor(name: str) -> str:
    try:
        return (WEB / "vendor" / name).read_text()
    except FileNotFoundError as error:
        raise ProblemError(
            "conversion_failed",
            "This server was installed without PlayCanvas, which the viewer in the file is made of.",
            advice="Run `make install` where npm is installed, or download the model as sog.",
        ) from error


def _data(content: bytes, media_type: str = "text/javascript") -> str:
    return f"data:{media_type};base64,{base64.b64encode(content).decode()}"
