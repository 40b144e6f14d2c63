"""The `.spz` library of Niantic and Adobe, compiled to WebAssembly and run in Node: the format's own reader and writer.

It is asked for the frame right-down-front, that of the standard `.ply`, and turns what the file holds by itself.
`@adobe/spz` is a development dependency of `server/web/package.json`.
"""

import json
import subprocess
from pathlib import Path

import torch

from splatmill_worker.splat.gaussians import Gaussians
from tests.support.paths import ROOT
from tests.support.programs import node

WEB = ROOT / "server/web"

_PROGRAM = """
import { readFileSync, writeFileSync } from 'node:fs';
import createSpzModule from '@adobe/spz';
const spz = await createSpzModule();
const RDF = spz.CoordinateSystem.RDF;
const [task, source, target, version, bits] = process.argv.slice(1);
const names = ['positions', 'scales', 'rotations', 'alphas', 'colors', 'sh'];
if (task === 'read') {
    const cloud = spz.loadSpzFromBuffer(new Uint8Array(readFileSync(source)), { to: RDF });
    const { numPoints, shDegree, antialiased } = cloud;
    const arrays = Object.fromEntries(names.map((name) => [name, Array.from(cloud[name])]));
    writeFileSync(target, JSON.stringify({ numPoints, shDegree, antialiased, ...arrays }));
} else {
    const cloud = { extensions: [], ...JSON.parse(readFileSync(source)) };
    for (const name of names) cloud[name] = Float32Array.from(cloud[name]);
    const options = { version: Number(version), from: RDF, sh1Bits: Number(bits), shRestBits: Number(bits) };
    writeFileSync(target, spz.saveSpzToBuffer(cloud, options));
}
"""


def _run(*arguments: str) -> None:
    done = subprocess.run(
        [*node("@adobe/spz"), "--input-type=module", "-e", _PROGRAM, *arguments],
        cwd=WEB,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr


def read(path: Path) -> tuple[Gaussians, bool]:
    """What the library reads, and its flag `antialiased`. Skips the test where it is not installed."""
    target = path.with_suffix(".json")
    _run("read", str(path), str(target))
    cloud = json.loads(target.read_text())
    n = cloud["numPoints"]

    def table(name: str, *shape: int) -> torch.Tensor:
        return torch.tensor(cloud[name], dtype=torch.float32).reshape(n, *shape)

    rest = (cloud["shDegree"] + 1) ** 2 - 1
    gaussians = Gaussians(
        table("positions", 3),
        table("scales", 3),
        table("rotations", 4)[:, [3, 0, 1, 2]],
        table("alphas"),
        torch.cat([table("colors", 1, 3), table("sh", rest, 3)], dim=1),
    )
    return gaussians, cloud["antialiased"]


def write(path: Path, gaussians: Gaussians, *, version: int, bits: int) -> None:
    """Let the library write Gaussians; `bits` of a harmonic. Skips the test where it is not installed."""
    cloud = {
        "numPoints": gaussians.count,
        "shDegree": gaussians.degree,
        "antialiased": True,
        "positions": gaussians.means.flatten().tolist(),
        "scales": gaussians.log_scales.flatten().tolist(),
        "rotations": gaussians.quats[:, [1, 2, 3, 0]].flatten().tolist(),
        "alphas": gaussians.logit_opacities.tolist(),
        "colors": gaussians.sh[:, 0].flatten().tolist(),
        "sh": gaussians.sh[:, 1:].flatten().tolist(),
    }
    source = path.with_suffix(".json")
    source.write_text(json.dumps(cloud))
    _run("write", str(source), str(path), str(version), str(bits))
