"""The list of hostile inputs, each with the answer that it must get. docs/generate/hostile.py prints it."""

from __future__ import annotations

from tests.support.hostile.entry import Hostile
from tests.support.hostile.tables.colors import COLORS
from tests.support.hostile.tables.decoders import DECODERS
from tests.support.hostile.tables.files import FILES
from tests.support.hostile.tables.headers import HEADERS
from tests.support.hostile.tables.labels import LABELS
from tests.support.hostile.tables.lenses import LENSES
from tests.support.hostile.tables.meshes import MESHES
from tests.support.hostile.tables.models import MODELS
from tests.support.hostile.tables.others import OTHERS
from tests.support.hostile.tables.panoramas import PANORAMAS
from tests.support.hostile.tables.poses import POSES
from tests.support.hostile.tables.presentation import PRESENTATION
from tests.support.hostile.tables.programs import PROGRAMS
from tests.support.hostile.tables.proxies import PROXIES
from tests.support.hostile.tables.requests import REQUESTS
from tests.support.hostile.tables.services import SERVICES
from tests.support.hostile.tables.unpacked import UNPACKED

HOSTILE: tuple[Hostile, ...] = (
    *REQUESTS,
    *HEADERS,
    *PROXIES,
    *SERVICES,
    *OTHERS,
    *FILES,
    *UNPACKED,
    *POSES,
    *PRESENTATION,
    *LABELS,
    *PROGRAMS,
    *LENSES,
    *MODELS,
    *MESHES,
    *DECODERS,
    *COLORS,
    *PANORAMAS,
)
