"""The list of hostile inputs, each with the answer that it must get. docs/generate/hostile.py prints it."""

from __future__ import annotations

from tests.support.hostile.entry import Hostile
from tests.support.hostile.table_colors import COLORS
from tests.support.hostile.table_decoders import DECODERS
from tests.support.hostile.table_files import FILES
from tests.support.hostile.table_headers import HEADERS
from tests.support.hostile.table_labels import LABELS
from tests.support.hostile.table_lenses import LENSES
from tests.support.hostile.table_meshes import MESHES
from tests.support.hostile.table_models import MODELS
from tests.support.hostile.table_others import OTHERS
from tests.support.hostile.table_panoramas import PANORAMAS
from tests.support.hostile.table_poses import POSES
from tests.support.hostile.table_presentation import PRESENTATION
from tests.support.hostile.table_programs import PROGRAMS
from tests.support.hostile.table_proxies import PROXIES
from tests.support.hostile.table_requests import REQUESTS
from tests.support.hostile.table_services import SERVICES
from tests.support.hostile.table_unpacked import UNPACKED

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
