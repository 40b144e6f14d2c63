"""The addresses of the web page. Pages and their files hold no data of users, so everybody may load them; what they
show comes from `/v1`, with the session or the key of who looks."""

import json
from collections.abc import Callable
from html import escape
from pathlib import Path

from fastapi import APIRouter, Request
from starlette.responses import FileResponse, Response

from splatmill.schema import POSTER, SharedModel
from splatmill_server.base.problems import ProblemError
from splatmill_server.base.root_path import own_path
from splatmill_server.service import Service, Shared
from splatmill_server.web import policy
from splatmill_server.web.tree import StaticFile, Tree

router = APIRouter(include_in_schema=False)

PAGE = Tree(Path(__file__).parent / "page")
"""The page's own files."""

VENDOR = Tree(Path(__file__).parent / "vendor")
"""JavaScript of others, which `server/web/packages.py` fetches."""

HEAD_HERE = "<!-- head -->"
"""Where a page's HEAD goes."""

IMPORT_MAP_HERE = "<!-- import map -->"
"""Where the import map goes in HEAD."""

HEAD = f"""<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<link rel="icon" href="/page/icon.svg" type="image/svg+xml">
<script src="/page/theme.js"></script>
{IMPORT_MAP_HERE}
<link rel="stylesheet" href="/page/base.css">"""
"""What the heads of all pages have in common."""

POSTER_HERE = "<!-- poster -->"
"""Where the picture of a shared model goes, which browsers show before any script has run."""

PICTURES = (POSTER, "preview.jpg")
"""The files with a picture of a model, the first before the second."""

PAGES = {
    "/": "new/new.html",
    "/jobs": "lists/jobs.html",
    "/jobs/{job_id}": "job/job.html",
    "/models": "lists/models.html",
    "/models/{model_id}": "model/model.html",
    "/compare": "beside/beside.html",  # two models
    "/open": "open/open.html",  # a file of the visitor's own, which is not sent to the server
    "/sign-in": "sign-in/sign-in.html",
    "/glossary": "plain/glossary.html",
}
"""The pages that are the same for everybody, by address."""

_FOREVER = "public, max-age=31536000, immutable"
_METHODS = ["GET", "HEAD"]


def _shown(name: str) -> Callable[[Request], Response]:
    """Return the endpoint of the page `name`."""

    def shown(request: Request) -> Response:
        return page(request, name)

    return shown


for address, name in PAGES.items():
    router.add_api_route(address, _shown(name), methods=_METHODS)


def missing_page(request: Request) -> Response:
    """What people see at an address that has no page."""
    shown = page(request, "plain/missing.html")
    shown.status_code = 404
    return shown


@router.api_route("/s/{token}", methods=_METHODS)
def share_page(service: Shared, request: Request, token: str) -> Response:
    """A model that somebody has shared."""
    return _shared(service, request, token, embedded=False)


@router.api_route("/s/{token}/embed", methods=_METHODS)
def embedded_page(service: Shared, request: Request, token: str) -> Response:
    """The viewer of a shared model alone, for a frame in pages of others."""
    return _shared(service, request, token, embedded=True)


@router.api_route("/page/{digest}/{name:path}", methods=_METHODS)
def page_file(request: Request, digest: str, name: str) -> Response:
    """A file of the page."""
    return _asset(request, PAGE, digest, name)


@router.api_route("/vendor/{digest}/{name:path}", methods=_METHODS)
def vendor_file(request: Request, digest: str, name: str) -> Response:
    """A file of others' JavaScript."""
    return _asset(request, VENDOR, digest, name)


def page(
    request: Request, name: str, *, embedded: bool = False, head: str = "", poster: str = ""
) -> Response:
    """Return the page `name` with the addresses of the files that it loads.

    embedded: whether pages of others may show it in a frame.
    head: elements for the page's head.
    poster: the element of the model's picture.
    """
    file = PAGE.find(name)
    if file is None:
        raise ProblemError("not_found", f"There is nothing at {request.url.path}.")
    # Relative, so that a page works below any path: what the browser knows of it, the server need not know.
    root = "../" * (own_path(request.scope).count("/") - 1) or "./"
    imports = import_map(root)
    text = (
        file.path.read_text(encoding="utf-8")
        .replace(HEAD_HERE, HEAD, 1)
        .replace(POSTER_HERE, poster, 1)
        .replace('"/page/', f'"/page/{PAGE.digest}/')
        .replace('="/', f'="{root}')
    )
    inserted = f'<script type="importmap">{imports}</script>{head}' if imports else head
    text = text.replace(IMPORT_MAP_HERE, inserted, 1)
    if not imports:
        text = text.replace("<html ", '<html data-viewer="missing" ', 1)
    security = policy.headers([imports] if imports else [], embedded=embedded)
    return Response(text, media_type="text/html", headers={"Cache-Control": "no-cache", **security})


def _shared(service: Service, request: Request, token: str, *, embedded: bool) -> Response:
    """Return the page of a link, whose status says whether the link is valid; the page says it to people."""
    status, head, poster = 200, "", ""
    try:
        model = service.shares.get_model(service.shares.get(token))
        head = _card(str(request.base_url), token, model)
        if (picture := _picture(model)) is not None:
            said = escape(f"A picture of {model.name or 'the scene'}")
            poster = f'<img class="still" src="/s/{token}/model/files/{picture}" alt="{said}" fetchpriority="high">'
    except ProblemError as error:
        status = error.problem.status
    name = "share/embed.html" if embedded else "share/share.html"
    shown = page(request, name, embedded=embedded, head=head, poster=poster)
    shown.status_code = status
    shown.headers["X-Robots-Tag"] = "noindex"
    return shown


def _picture(model: SharedModel) -> str | None:
    """Return the file with the picture of a model; None where it has none."""
    names = {file.name for file in model.files}
    return next((picture for picture in PICTURES if picture in names), None)


def _card(base: str, token: str, model: SharedModel) -> str:
    """Return the elements by which messengers show a picture of the model beside a link to it."""
    quality = f", {model.psnr:.1f} dB on photos not trained on" if model.psnr is not None else ""
    card = {
        "og:type": "website",
        "og:title": model.name or "A scene in 3D",
        "og:description": f"{model.gaussians:,} Gaussians{quality}. Look at it from any side.",
        "og:url": f"{base}s/{token}",
        "twitter:card": "summary_large_image",
    }
    if (picture := _picture(model)) is not None:
        card["og:image"] = f"{base}s/{token}/model/files/{picture}"
    return "".join(f'\n<meta property="{name}" content="{escape(text)}">' for name, text in card.items())


def import_map(root: str) -> str:
    """Return the import map as JSON, or "" if the packages have not been fetched.

    root: relative address of the server, which ends with a slash.
    """
    known = VENDOR.folder / "imports.json"
    if not known.is_file():
        return ""
    imports = json.loads(known.read_text(encoding="utf-8"))["imports"]
    return json.dumps(
        {"imports": {name: f"{root}vendor/{VENDOR.digest}/{path}" for name, path in imports.items()}}
    )


def _asset(request: Request, tree: Tree, digest: str, name: str) -> Response:
    """Return a file of a tree: for ever under its digest; a page of another version gets it too, but for once."""
    current, file = tree.is_current(digest), tree.find(name)
    if file is None:
        raise ProblemError("not_found", f"There is nothing at {request.url.path}.")
    packed = file.packed if _accepts_gzip(request) else None
    etag = f'"{file.etag}-gzip"' if packed is not None else f'"{file.etag}"'
    headers = {
        "ETag": etag,
        "Cache-Control": _FOREVER if current else "no-cache",
        "Content-Type": file.media_type,
        "Vary": "Accept-Encoding",
        # A worker or a frame made of this file is held to the same rules.
        "Content-Security-Policy": policy.headers()["Content-Security-Policy"],
    }
    if etag in (tag.strip() for tag in request.headers.get("if-none-match", "").split(",")):
        return Response(status_code=304, headers=headers)
    return _content(request, file, packed, headers)


def _content(request: Request, file: StaticFile, packed: bytes | None, headers: dict[str, str]) -> Response:
    if packed is None:
        return FileResponse(file.path, headers=headers)
    headers |= {"Content-Encoding": "gzip", "Content-Length": str(len(packed))}
    return Response(b"" if request.method == "HEAD" else packed, headers=headers)


def _accepts_gzip(request: Request) -> bool:
    accepted = (part.strip().lower() for part in request.headers.get("accept-encoding", "").split(","))
    return any(part == "gzip" or (part.startswith("gzip;") and not part.endswith("q=0")) for part in accepted)
