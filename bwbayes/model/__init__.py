"""The forward model: Bouc-Wen hysteresis, linear dynamics, and the actuator made of both."""
