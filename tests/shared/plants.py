"""Parameters of the simulated robots of tests, by name."""

from modsoft.runtime import robot as robot_file
from modsoft.training.simulation.parameters import plant_of

PARAMETERS = {
    name: plant_of(robot_file.load(robot))
    for name, robot in (("cable", "cable-4"), ("pneumatic", "pneumatic-3"), ("pneumatic-2", "pneumatic-2"))
}
CABLE, PNEUMATIC, PNEUMATIC_2 = PARAMETERS.values()
