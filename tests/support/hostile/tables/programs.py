"""Hostile cameras in files of Metashape, RealityScan, Bundler and OpenSfM."""

from __future__ import annotations

from tests.support.hostile.entry import Hostile

INVALID = "the job fails: `poses_invalid`"

_LAUGHS = "".join(f'<!ENTITY a{k + 1} "{f"&a{k};" * 10}">' for k in range(9))


def _file(what: str, name: str, data: str, said: str) -> Hostile:
    return Hostile("Poses", what, lambda bench: bench.posed({f"poses/{name}": data.encode()}), INVALID, said)


PROGRAMS = (
    _file(
        "a file of Metashape whose entities expand to a billion",
        "cameras.xml",
        f'<!DOCTYPE d [<!ENTITY a0 "ha">{_LAUGHS}]><document><chunk label="&a9;"><sensors/></chunk></document>',
        "a document type or entities",
    ),
    _file(
        "a file of Metashape with elements in 100,000 elements",
        "cameras.xml",
        "<document><chunk><sensors/><cameras>" + "<group>" * 100_000,
        "could not be read",
    ),
    _file(
        "a file of Bundler that announces a trillion points",
        "bundle.out",
        "# Bundle file v0.3\n0 1000000000000\n",
        "it announces 0 cameras and 1000000000000 points",
    ),
    _file(
        "a file of OpenSfM with lists in 100,000 lists",
        "reconstruction.json",
        '[{"cameras": {}, "shots": ' + "[" * 100_000,
        "could not be read",
    ),
    _file(
        "a table of RealityScan with a number of 400 digits",
        "r.csv",
        f"#name,x,y,alt,heading,pitch,roll,f\na.jpg,{'9' * 400},0,0,0,0,0,30\n",
        "which is not finite",
    ),
)
