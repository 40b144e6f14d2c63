"""The pattern of the ids of captures, jobs and models."""

import re

ID = re.compile(r"[a-z0-9]{8,40}", re.ASCII)
