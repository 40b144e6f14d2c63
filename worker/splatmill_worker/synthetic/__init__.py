"""A built-in still life with exact cameras: the demo's capture, and ground truth for tests and benchmarks."""

from splatmill_worker.synthetic.captures import capture
from splatmill_worker.synthetic.light import Light
from splatmill_worker.synthetic.movers import Movers
from splatmill_worker.synthetic.ray_caster import StillLife, look_at, orbit, photograph, still_life
from splatmill_worker.synthetic.scanner import scan

__all__ = ["Light", "Movers", "StillLife", "capture", "look_at", "orbit", "photograph", "scan", "still_life"]
