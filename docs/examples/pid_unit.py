"""A PID controller as an FMU of FMI 3.0, made with PythonFMU3 for fmu_pid.py.

pythonfmu3 build -f docs/examples/pid_unit.py        (makes the file alone)
"""

from pythonfmu3 import Float64, Fmi3Causality, Fmi3Slave, Fmi3Variability


class Pid(Fmi3Slave):
    """output = kp e + ki int(e) + kd de/dt, where e = target - measured."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.time = 0.0
        self.target, self.measured, self.rate, self.output = 0.0, 0.0, 0.0, 0.0
        self.kp, self.ki, self.kd = 40.0, 60.0, 6.0
        self.integral = 0.0
        continuous, tunable = Fmi3Variability.continuous, Fmi3Variability.tunable
        self.register_variable(
            Float64("time", causality=Fmi3Causality.independent, variability=continuous)
        )
        for name in ("target", "measured", "rate"):
            self.register_variable(
                Float64(name, causality=Fmi3Causality.input, variability=continuous)
            )
        self.register_variable(
            Float64("output", causality=Fmi3Causality.output, variability=continuous)
        )
        for name in ("kp", "ki", "kd"):
            self.register_variable(
                Float64(name, causality=Fmi3Causality.parameter, variability=tunable)
            )

    def do_step(self, current_time, step_size):
        """Compute the output for one communication step."""
        error = self.target - self.measured
        self.integral += error * step_size
        self.output = self.kp * error + self.ki * self.integral - self.kd * self.rate
        return True
