"""How likely recordings make a model of an arm: torque as columns times coefficients, its noise, its evidence."""
