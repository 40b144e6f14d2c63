"""Which server is chosen, with which key and certificates: arguments, environment, profiles; and TLS that is real.

Does not prove that a proxy passes requests on, which is httpx's part; the scripted server plays one here.
"""

import json
import ssl
import subprocess
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest

from splatmill import Client
from splatmill.cli.exits import Exit
from splatmill.errors import ConfigurationInvalid, ConnectionFailed
from splatmill.transfer.profiles import config_path, profile_names, read_profile
from splatmill.transfer.server_choice import choose_server
from tests.support.command_line import invoke
from tests.support.programs import program

LAB = """
[profiles.lab]
server = "https://lab.example"
api_key_file = "keys/lab"
ca_bundle = "lab.pem"
proxy = "http://proxy.example:3128"

[profiles.bare]
server = "http://bare.example:8080"
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the configuration, of nobody real."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    for name in ("SPLATMILL_PROFILE", "SPLATMILL_CA_BUNDLE"):
        monkeypatch.delenv(name, raising=False)
    made = tmp_path / "config" / "splatmill"
    (made / "keys").mkdir(parents=True)
    return made


@pytest.fixture
def lab(folder: Path) -> Path:
    write(folder / "config.toml", LAB)
    write(folder / "keys" / "lab", "lab-key\n")
    return folder


def write(path: Path, text: str, mode: int = 0o600) -> None:
    path.write_text(text)
    path.chmod(mode)


def test_a_profile_is_an_address_a_key_certificates_and_a_proxy(lab: Path):
    profile = read_profile("lab")
    assert (profile.server, profile.api_key) == ("https://lab.example", "lab-key")
    assert (profile.ca_bundle, profile.proxy) == (lab / "lab.pem", "http://proxy.example:3128")
    assert profile_names() == ["bare", "lab"]
    assert config_path() == lab / "config.toml"


def test_arguments_come_before_the_environment_and_that_before_a_profile_it_names(lab: Path, monkeypatch):
    def chosen(*arguments, **options) -> tuple[str, str | None]:
        choice = choose_server(*arguments, **options)
        return choice.server, choice.api_key

    assert chosen(None) == ("http://127.0.0.1:8080", None)
    monkeypatch.setenv("SPLATMILL_PROFILE", "lab")
    assert chosen(None) == ("https://lab.example", "lab-key")
    assert chosen(None, api_key="mine") == ("https://lab.example", "mine")
    assert chosen("http://other.example") == ("http://other.example", None), (
        "a key goes to its own server only"
    )
    assert chosen(None, profile="bare") == ("http://bare.example:8080", None)
    monkeypatch.setenv("SPLATMILL_API_KEY", "of-the-environment")
    assert chosen(None) == ("https://lab.example", "of-the-environment")
    assert chosen(None, profile="lab") == ("https://lab.example", "lab-key")
    monkeypatch.setenv("SPLATMILL_SERVER", "http://elsewhere.example")
    assert chosen(None) == ("http://elsewhere.example", "of-the-environment")
    assert chosen(None, profile="lab") == ("https://lab.example", "lab-key")
    with pytest.raises(ConfigurationInvalid, match="Give one of them"):
        chosen("http://other.example", profile="lab")


def test_certificates_are_chosen_in_the_same_order(lab: Path, monkeypatch):
    assert choose_server(None, profile="lab").verify == lab / "lab.pem"
    assert choose_server(None, profile="bare").verify is True
    assert choose_server(None, profile="lab", verify=False).verify is False
    monkeypatch.setenv("SPLATMILL_CA_BUNDLE", "/ca.pem")
    assert choose_server(None).verify == "/ca.pem"
    assert choose_server(None, profile="lab").verify == lab / "lab.pem"
    monkeypatch.setenv("SPLATMILL_PROFILE", "lab")
    assert choose_server(None).verify == "/ca.pem"


@pytest.mark.parametrize(
    ("text", "mode", "sentence"),
    [
        ("[profiles.lab]", 0o600, "has no server"),
        ("[profiles.other]\nserver = 'http://a'", 0o600, "no profile 'lab' in .*; its profiles are: other"),
        ("[profiles.lab]\nserver = 'http://a'\ntoken = 'x'", 0o600, "unknown field 'token'"),
        ("[profiles.lab]\nserver = 3", 0o600, "a server that is not a text"),
        ("[profiles.lab]\nserver = 'http://a'\napi_key = 'x'", 0o644, "chmod 600"),
        ("[profiles.lab]\nserver = 'http://a'\napi_key = 'x'\napi_key_file = 'y'", 0o600, "has both"),
        ("[profiles.lab]\nserver = 'http://a'\napi_key_file = 'gone'", 0o600, "cannot be read"),
        ("[profiles.lab]\nserver = 'http://a'\napi_key_file = 'keys/empty'", 0o600, "does not hold one key"),
        ("[profiles.lab]\nserver = 'http://a'\napi_key_file = 'keys/open'", 0o600, "chmod 600"),
        ("profiles = ", 0o600, "Correct it as TOML"),
        ("", 0o600, "its profiles are: none"),
    ],
)
def test_what_is_wrong_with_a_profile_is_said(folder: Path, text: str, mode: int, sentence: str):
    write(folder / "config.toml", text, mode)
    write(folder / "keys" / "empty", "\n")
    write(folder / "keys" / "open", "key", 0o640)
    with pytest.raises(ConfigurationInvalid, match=sentence) as wrong:
        read_profile("lab")
    assert "'x'" not in str(wrong.value), "no key is shown"


def test_commands_take_a_profile(service, folder: Path, monkeypatch):
    write(folder / "config.toml", f'[profiles.here]\nserver = "{service.url}"\n')
    with Client(profile="here") as client:
        assert client.server == service.url
    assert "no jobs yet" in invoke("jobs", "--profile", "here").stdout
    done = invoke("jobs", "--profile", "gone")
    assert done.exit_code == Exit.usage
    assert "its profiles are: here" in done.stderr
    done = invoke("jobs", "--profile", "here", "--server", "http://a.example")
    assert done.exit_code == Exit.usage
    assert "Give --server or --profile" in done.output
    monkeypatch.setenv("SPLATMILL_PROFILE", "here")
    assert "no jobs yet" in invoke("jobs").stdout
    (folder / "photos").mkdir()
    for name in ("a.jpg", "b.jpg"):
        (folder / "photos" / name).write_bytes(name.encode())
    done = invoke("train", folder / "photos", "--detach", "-o", folder / "out")
    assert done.exit_code == 0, done.output
    assert done.stdout.split()[-1] in invoke("jobs").stdout, "it was started on the server of the profile"


def test_headers_are_sent_with_every_request(peer, reply):
    peer.answer = lambda _: reply(body=b'{"options": []}')
    with Client(peer.url, headers={"X-Team": "mill"}) as client:
        client.options()
    assert peer.requests[0].headers["x-team"] == "mill"


def test_requests_go_through_a_proxy(peer, reply):
    peer.answer = lambda _: reply(body=b'{"options": []}')
    with Client("http://splats.example", proxy=peer.url) as client:
        assert client.options() == []
    assert peer.requests[0].path == "http://splats.example/v1/options"


class _Options(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        body = json.dumps({"options": []}).encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def private(tmp_path: Path) -> Iterator[tuple[str, Path]]:
    """A server with a certificate that nobody else has signed: its address, and the certificate."""
    certificate, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    subject = ("-subj", "/CN=localhost", "-addext", "subjectAltName=IP:127.0.0.1")
    made = ("-newkey", "rsa:2048", "-nodes", "-keyout", str(key), "-out", str(certificate), "-days", "2")
    subprocess.run([program("openssl"), "req", "-x509", *made, *subject], check=True, capture_output=True)
    server = HTTPServer(("127.0.0.1", 0), _Options)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    server.socket = context.wrap_socket(server.socket, server_side=True)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"https://127.0.0.1:{server.server_port}", certificate
    server.shutdown()
    thread.join()
    server.server_close()


def test_certificates_of_ones_own_are_trusted(private, monkeypatch, tmp_path: Path):
    url, certificate = private
    with (
        Client(url, retries=0) as client,
        pytest.raises(ConnectionFailed, match=r"is not trusted.*SPLATMILL_CA_BUNDLE"),
    ):
        client.options()
    trusted = (certificate, str(certificate), ssl.create_default_context(cafile=str(certificate)), False)
    for verify in trusted:
        with Client(url, verify=verify) as client:
            assert client.options() == []
    monkeypatch.setenv("SPLATMILL_CA_BUNDLE", str(certificate))
    with Client(url) as client:
        assert client.options() == []
    monkeypatch.setenv("SPLATMILL_CA_BUNDLE", str(tmp_path / "gone.pem"))
    with pytest.raises(ConfigurationInvalid, match=r"gone\.pem cannot be read: No such file"):
        Client(url)
    (tmp_path / "nonsense.pem").write_text("nonsense")
    with pytest.raises(ConfigurationInvalid, match=r"nonsense\.pem cannot be read"):
        Client(url, verify=tmp_path / "nonsense.pem")
