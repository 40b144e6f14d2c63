"""`splatmill up --lan`: other devices get in over HTTPS and with a key alone, by the code in the terminal or on the
page.

Not proved here: what phones warn of, and a network with several machines in it.
"""

from __future__ import annotations

import io
import os
import ssl
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from PIL import Image
from playwright.sync_api import expect

from splatmill_server.base.tls import fingerprint
from splatmill_server.up import lan
from splatmill_server.up.certificate import certificate
from splatmill_server.up.folder import UpError
from tests.browser.conftest import Open
from tests.support.page.axe import violations
from tests.support.page.qr_code import read_code
from tests.support.up import Up


@pytest.fixture(scope="module")
def address() -> str:
    try:
        return lan.network_address()
    except UpError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def up(address: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Up]:
    """A service that was started for the local network, without a key of its operator's."""
    up = Up(tmp_path_factory.mktemp("lan") / "data").start("--lan")
    yield up
    up.close()


def key_of(up: Up) -> str:
    return (up.data / "lan" / "key").read_text().strip()


def test_other_devices_need_https_the_certificate_and_the_key(up: Up, address: str) -> None:
    base = up.http.base_url
    assert (base.scheme, base.host) == ("https", address)
    trusting = ssl.create_default_context(cafile=up.data / "lan" / "certificate.pem")
    for host in (address, "127.0.0.1", "localhost"):
        with httpx.Client(base_url=f"https://{host}:{base.port}", verify=trusting, timeout=60) as http:
            assert http.get("/v1/jobs").status_code == 401
            told = http.get("/v1/info", headers={"Authorization": f"Bearer {key_of(up)}"}).json()["lan"]
    assert told == {
        "url": str(base).rstrip("/"),
        "fingerprint": fingerprint(up.data / "lan" / "certificate.pem"),
    }
    with pytest.raises(httpx.ConnectError, match=r"self.signed"):
        httpx.get(f"{base}/v1/info", timeout=60)
    with pytest.raises(httpx.HTTPError):
        httpx.get(f"http://{address}:{base.port}/v1/info", timeout=60)
    for name in ("key", "certificate.key"):
        assert (up.data / "lan" / name).stat().st_mode & 0o077 == 0


def test_the_code_of_the_terminal_signs_a_phone_in(up: Up, open_window: Open) -> None:
    """The text of the code is in `test_the_operator_sees`."""
    visit = open_window(up, ignore_https_errors=True, viewport={"width": 390, "height": 780}, has_touch=True)
    visit.watched.allow("401")
    page, base = visit.page, str(up.http.base_url).rstrip("/")
    page.goto(f"{base}/sign-in#key=wrong")
    expect(page.get_by_role("alert")).to_contain_text("does not know this key")
    assert "#" not in page.url
    page.goto("about:blank")
    page.goto(f"{base}/sign-in#key={key_of(up)}")
    page.wait_for_url(f"{base}/")
    page.locator("html[data-ready]").wait_for()
    assert key_of(up) not in page.evaluate("document.cookie + location.href + JSON.stringify(localStorage)")


def test_the_page_of_the_machine_itself_shows_the_code_for_phones(
    up: Up, open_window: Open, address: str, tmp_path: Path
) -> None:
    port = up.http.base_url.port
    visit = open_window(f"https://127.0.0.1:{port}", ignore_https_errors=True, device_scale_factor=1)
    visit.watched.allow("401")
    page = visit.page
    page.goto(f"/sign-in#key={key_of(up)}")
    page.locator("html[data-ready]").wait_for()
    page.get_by_text("Take the photos with a phone").click()
    expect(page.get_by_role("img", name=f"QR code of https://{address}:{port}/")).to_be_visible()
    expect(page.locator("#phone-help")).to_contain_text(fingerprint(up.data / "lan" / "certificate.pem"))
    expect(page.locator("#phone-help")).to_contain_text("will ask for an API key")
    expect(page.locator("#phone-help")).not_to_contain_text(key_of(up))
    page.get_by_role("button", name="Show the key").focus()
    page.keyboard.press("Enter")
    expect(page.locator("#phone-help")).to_contain_text(f"API key: {key_of(up)}")
    expect(page.locator("#phone-help")).to_contain_text("can use all of the service")
    picture = Image.open(io.BytesIO(page.get_by_role("img", name="signs a phone in").screenshot())).convert(
        "RGBA"
    )
    assert read_code(picture, tmp_path) == f"https://{address}:{port}/sign-in#key={key_of(up)}"
    assert not violations(page)


def test_only_an_admin_is_shown_the_key(up: Up) -> None:
    owner = {"Authorization": f"Bearer {key_of(up)}"}
    answer = up.http.get("/v1/lan", headers=owner)
    assert (answer.json()["key"], answer.headers["cache-control"]) == (key_of(up), "no-store")
    body = {"name": "phone", "owner": "mum", "scopes": ["train"]}
    made = up.http.post("/v1/keys", json=body, headers=owner).json()
    for headers, status in (({}, 401), ({"Authorization": f"Bearer {made['secret']}"}, 403)):
        assert up.http.get("/v1/lan", headers=headers).status_code == status
    up.http.delete(f"/v1/keys/{made['id']}", headers=owner)


def test_the_operator_sees_what_is_open_and_the_code(up: Up, address: str, tmp_path: Path) -> None:
    sentences = lan.prepare(up.data, has_keys=False).sentences(f"https://{address}:8080", 8080)
    lines = sentences.splitlines()
    code = [line for line in lines if line and set(line) <= set(" █▀▄")]
    for said in (
        key_of(up),
        "port 8080",
        "only with a key",
        fingerprint(up.data / "lan" / "certificate.pem"),
    ):
        assert said in sentences
    # Each character is two pixels, one below the other; those that are drawn are light.
    rows = [[shape in pair for shape in line] for line in code for pair in ("█▀", "█▄")]
    scale = 8
    light = [
        [255 if rows[y // scale][x // scale] else 0 for x in range(scale * len(rows[0]))]
        for y in range(scale * len(rows))
    ]
    pixels = bytes(value for row in light for level in row for value in (level, level, level, 255))
    picture = Image.frombytes("RGBA", (len(light[0]), len(light)), pixels)
    assert read_code(picture, tmp_path) == f"https://{address}:8080/sign-in#key={key_of(up)}"


def test_key_and_certificate_are_kept_while_they_serve(up: Up, tmp_path: Path) -> None:
    first = lan.prepare(tmp_path, has_keys=False)
    print_of_first = fingerprint(first.certificate.file)
    assert lan.prepare(tmp_path, has_keys=False) == first
    assert fingerprint(first.certificate.file) == print_of_first
    assert lan.prepare(tmp_path, has_keys=True).key is None
    certificate(tmp_path / "lan", [first.address, "10.1.2.3"])
    moved = fingerprint(first.certificate.file)
    assert moved != print_of_first, "the machine has another address"
    first.certificate.file.write_text("damaged")
    certificate(tmp_path / "lan", [first.address])
    assert fingerprint(first.certificate.file) not in (moved, print_of_first)


def test_a_host_beside_lan_is_refused(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "splatmill_server.up",
        "--lan",
        "--host",
        "192.0.2.9",
        "--data",
        str(tmp_path / "data"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, env=dict(os.environ))
    assert done.returncode == 1
    assert "Leave out --host" in done.stderr
    assert not (tmp_path / "data").exists()
