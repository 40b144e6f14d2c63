"""The page through the proxy of the inputs, which publishes it below a path and says nothing of that: what it loads is
found below the path too, with `--root-path`.

Does not prove that a browser shows it, nor other proxies; tests/browser/test_root_path.py does.
"""

from __future__ import annotations

import re
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urljoin

import httpx
import pytest

from splatmill_server.base.settings import Settings
from tests.inputs.conftest import INPUTS
from tests.support.redis_server import connect, empty_redis
from tests.support.served_app import served_app
from tests.support.waiting import wait_for

PORTS = {"proxy": "18950", "server": "18941"}
"""In the script of the inputs."""


def accepts(port: int) -> bool:
    with socket.socket() as client:
        return client.connect_ex(("127.0.0.1", port)) == 0


@contextmanager
def proxy(server: int) -> Iterator[str]:
    """The proxy of the inputs on a free port, before the server on this port; yields its address."""
    if not INPUTS.is_dir():
        pytest.skip("the shared inputs are not on this machine")
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    script = (INPUTS / "path-prefix/build.py").read_text()
    for name, own in (("proxy", port), ("server", server)):
        assert PORTS[name] in script
        script = script.replace(PORTS[name], str(own))
    with subprocess.Popen([sys.executable, "-c", script], stderr=subprocess.DEVNULL) as process:
        try:
            wait_for(lambda: accepts(port))
            yield f"http://127.0.0.1:{port}/splats/"
        finally:
            process.kill()


@pytest.mark.slow
def test_what_the_page_loads_is_found_below_the_path(tmp_path: Path) -> None:
    with empty_redis(tmp_path) as url:
        settings = Settings(redis_url=url, data=tmp_path / "data", reaper_interval=3600, root_path="/splats")
        with served_app(settings, connect(url)) as app, proxy(app.address[1]) as address:
            page = httpx.get(address, follow_redirects=True, timeout=60)
            assert page.status_code == 200
            named = set(re.findall(r'(?:src|href)="([^"#]+)"', page.text))
            loaded = {urljoin(str(page.url), each) for each in named if not each.startswith("data:")}
            own = {each for each in loaded if each.startswith("http://127.0.0.1")}
            assert {each.rpartition(".")[2] for each in own} >= {"js", "css"}
            for each in own:
                assert each.startswith(address), each
                assert httpx.get(each, follow_redirects=True, timeout=60).status_code == 200, each
            assert httpx.get(urljoin(address, "v1/info"), timeout=60).json()["accepted"]["photos"]
