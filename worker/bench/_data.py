"""Where the shared captures lie: beside the project, never inside it (their licences forbid that)."""

from __future__ import annotations

from pathlib import Path

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
FOLDERS = {
    "fox": "fox_540x960",
    "lego": "lego_400",
    "lego-800": "lego_800",
    "lund": "lund_1024x768_gps",
    "kermit": "kermit_640x480",
    "beer": "beer_720",
    "snowmiku": "snowmiku_1008",
    "unrelated": "failure_unrelated_640",
    "room": "room_464",
    "rotation": "failure_pure_rotation",
}
