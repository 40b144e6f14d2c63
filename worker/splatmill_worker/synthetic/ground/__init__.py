"""A generated town flown over in strips: photos with GPS and exact cameras, for as many photos as are asked for."""

from splatmill_worker.synthetic.ground.capture import capture
from splatmill_worker.synthetic.ground.caster import depths, photograph
from splatmill_worker.synthetic.ground.flight import Flight
from splatmill_worker.synthetic.ground.town import Town

__all__ = ["Flight", "Town", "capture", "depths", "photograph"]
