import gapcert as gc


@gc.hookimpl
def gapcert_components():
    return [gc.Component("backend", "acme-puck", "the speed of a puck on ice", "gapcert_acme:Puck")]


class Puck(gc.Backend):
    states, inputs, period = (gc.StateSpec("v", "m/s"),), (gc.StateSpec("a", "m/s^2"),), 0.01

    def _step(self, x, u):
        return x + self.period * u
