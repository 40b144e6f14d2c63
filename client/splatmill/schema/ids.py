"""The shape of the ids that captures, jobs and models are known by."""

import re

ID = re.compile(r"[a-z0-9]{8,40}", re.ASCII)
