"""Reads QR codes with the JavaScript package that the page draws them by."""

import json
import subprocess
from pathlib import Path

from PIL import Image

from tests.support.paths import ROOT
from tests.support.programs import node

WEB = ROOT / "server" / "web"


def read_code(picture: Image.Image, folder: Path) -> str:
    """The text of a QR code in a picture RGBA. folder: a temporary one."""
    (folder / "pixels").write_bytes(picture.tobytes())
    program = f"""
        import decodeQR from "qr/decode.js"; import fs from "node:fs";
        const data = new Uint8Array(fs.readFileSync({json.dumps(str(folder / "pixels"))}));
        console.log(decodeQR({{ width: {picture.width}, height: {picture.height}, data }}));"""
    command = [*node("qr"), "--input-type=module", "-e", program]
    done = subprocess.run(command, cwd=WEB, capture_output=True, text=True, timeout=60)
    assert done.stdout, done.stderr
    return done.stdout.strip()
