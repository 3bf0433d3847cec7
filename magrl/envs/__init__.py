"""The navigation environment, its scenarios and trips, and its Gymnasium interface (:mod:`magrl.envs.gymnasium`)."""

from magrl.envs.geomagnetic import GeomagneticNavEnv as GeomagneticNavEnv
from magrl.envs.random_regions import earth_scenario as earth_scenario
from magrl.envs.random_regions import planet_scenario as planet_scenario
from magrl.envs.regions import PAPER_REGION as PAPER_REGION
from magrl.envs.regions import Region as Region
from magrl.envs.regions import Regions as Regions
from magrl.envs.scenario import Scenario as Scenario
from magrl.envs.scenario import load_scenario as load_scenario
from magrl.envs.specs import PRIVILEGED_KEYS as PRIVILEGED_KEYS
from magrl.envs.specs import PUBLIC_KEYS as PUBLIC_KEYS
from magrl.envs.trips import TRIP_SETS as TRIP_SETS
from magrl.envs.trips import Trips as Trips
from magrl.envs.trips import named_trips as named_trips
from magrl.envs.trips import trip_set as trip_set
