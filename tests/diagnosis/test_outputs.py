"""What only an output shows: a sensor of force, current or acceleration whose equation lacks something that moves nothing."""

import numpy as np
import pytest
from scipy.signal import lfilter

import gapcert as gc
from gapcert.plugin import Recording, Trajectory

H, N = 0.01, 2400
T = H * np.arange(N)
MOTOR = {
    "states": {"w": "rad/s"},
    "inputs": {"u": "V"},
    "parameters": {"tau": {"value": "0.2 s", "tolerance": "3 %"}, "k": "4 rad/s/V", "R": "1.5 ohm", "c": "0.2 V*s/rad"},
    "derivative": {"w": "(k*u - w)/tau"},
    "outputs": {"w": "w", "i": "(u - c*w)/R"},
}
STRUT = {
    "states": {"x": "m"},
    "inputs": {"v": "m/s"},
    "parameters": {"c": {"value": "300 N*s/m", "tolerance": "5 %"}, "k": {"value": "2000 N/m", "tolerance": "5 %"}},
    "derivative": {"x": "v"},
    "outputs": {"x": "x", "F": "c*v + k*x"},
}


def drive(rng, kind):
    if kind == "steps":
        return rng.normal(size=N // 40).repeat(40)
    return sum(rng.normal() * np.sin(2 * np.pi * f * T + rng.uniform(0, 6)) for f in rng.uniform(0.1, 2.5, 6))


def held(pull, u):
    y = 0.0
    for value in u:
        yield y
        y = pull(y, value)


def motion(name, rng, kind):
    """(model, input, state, output), without noise, as the model has them."""
    u = drive(rng, kind)
    if name == "motor":
        w = np.array(list(held(lambda y, a: 4 * a + (y - 4 * a) * np.exp(-H / 0.2), u)))
        return MOTOR, u, w, (u - 0.2 * w) / 1.5
    x = np.array(list(held(lambda y, a: y + H * a, 0.3 * u)))
    return STRUT, 0.3 * u, x, 300 * 0.3 * u + 2000 * x


def play(z, half):
    at, out = z[0], []
    for value in z:
        at = min(max(at, value - half), value + half)
        out.append(value - at)
    return np.array(out)


LACKS = {
    "a cubic": lambda u, z: (z / z.std()) ** 3,
    "a kink": lambda u, z: np.abs(u),
    "dry friction": lambda u, z: np.tanh(30 * u / u.std()),
    "a product": lambda u, z: u * z,
    "a lag": lambda u, z: lfilter([H / 0.3], [1, H / 0.3 - 1], u),
    "hysteresis": lambda u, z: play(z, 0.3 * z.std()),
}


def diagnosed(name, lack, floors, seed, kind="smooth", colour=0.0):
    """The diagnosis of a log whose last output lacks something of so many noise floors."""
    rng = np.random.default_rng(seed)
    data, u, z, y = motion(name, rng, kind)
    noise = [lfilter([np.sqrt(1 - colour**2)], [1, -colour], rng.normal(size=N)) for _ in range(2)]
    sigma = 0.01 * y.std()
    beside = np.zeros(N) if lack is None else LACKS[lack](u, z)
    beside = beside * floors * sigma / (beside.std() or 1.0)
    shown, inputs = list(data["outputs"]), list(data["inputs"])
    channels = {shown[0]: z + 0.003 * z.std() * noise[0], shown[1]: y + beside + sigma * noise[1], inputs[0]: u}
    config = gc.registry().config("model", "equations").model_validate({"kind": "equations", "period": f"{H} s", **data})
    model = gc.registry().build("model", "equations", config, gc.Context(None))
    return gc.diagnose(model, Recording((Trajectory(T, channels, "log"),), {}, "zero"))


@pytest.mark.exam
@pytest.mark.parametrize("lack", LACKS)
@pytest.mark.parametrize(("name", "kind"), [("motor", "steps"), ("strut", "smooth")])
def test_nothing_is_no_answer_to_what_an_output_shows(name, kind, lack):
    found = diagnosed(name, lack, 8.0, 11, kind)
    assert found.verdict != "nothing"
    if found.verdict == "unexplained":
        assert found.unexplained.looks_like
    else:
        assert found.causes


@pytest.mark.parametrize("lack", [pytest.param("dry friction", marks=pytest.mark.exam), "hysteresis"])
def test_what_is_left_is_told_by_its_kind(lack):
    found = diagnosed("strut", lack, 20.0, 5)
    assert found.verdict == "unexplained"
    kinds = found.unexplained.looks_like
    expected = {"dry friction": "static", "hysteresis": "position memory"}[lack]
    assert max(kinds, key=lambda k: kinds[k]) == expected
    assert found.unexplained.needs_memory == (lack == "hysteresis")


def test_noise_is_nothing():
    assert diagnosed("strut", None, 0.0, 1, "steps", 0.5).verdict == "nothing"


@pytest.mark.exam
@pytest.mark.parametrize("colour", [0.0, 0.5, 0.9])
@pytest.mark.parametrize("name", ["motor", "strut"])
def test_noise_of_any_colour_is_nothing(name, colour):
    for seed in range(3):
        assert diagnosed(name, None, 0.0, seed, ("smooth", "steps")[seed % 2], colour).verdict == "nothing"


@pytest.mark.exam
def test_an_output_alone_whose_state_nothing_shows_is_answered():
    """The strut's force alone: its position is in no channel, and moves none but through the force."""
    rng = np.random.default_rng(2)
    data, v, _, force = motion("strut", rng, "smooth")
    data = {**data, "outputs": {"F": "c*v"}}
    config = gc.registry().config("model", "equations").model_validate({"kind": "equations", "period": f"{H} s", **data})
    model = gc.registry().build("model", "equations", config, gc.Context(None))
    noisy = force + 0.01 * force.std() * rng.normal(size=N)
    found = gc.diagnose(model, Recording((Trajectory(T, {"F": noisy, "v": v}, "log"),), {}, "zero"))
    assert found.verdict == "unexplained"
    assert np.isfinite([m.after for m in found.residual.values()]).all()


def path(rng, kind):
    """(input, what acts of it, at the instants of its samples): held between them, from rest."""
    u = np.zeros(N)
    u[20:] = (rng.uniform(0.4, 1.0, N // 30) * rng.choice([-1, 1], N // 30)).repeat(30)[: N - 20]
    if kind == "input-saturation":
        return u, np.clip(u, -0.7, 0.7), {"level": 0.7}
    if kind == "input-dead-zone":
        return u, u - np.clip(u, -0.25, 0.25), {"width": 0.25}
    if kind == "input-delay":
        return u, np.concatenate([np.zeros(3), u[:-3]]), {"delay": 3 * H}
    return u, np.array(list(held(lambda y, a: a + (y - a) * np.exp(-H / 0.06), u))), {"time_constant": 0.06}


@pytest.mark.parametrize(
    "kind",
    ["input-dead-zone", *(pytest.param(k, marks=pytest.mark.exam) for k in ("input-saturation", "input-delay", "input-lag"))],
)
def test_what_happens_to_an_input_reaches_the_outputs_it_drives(kind):
    """An accelerometer on a damped mass: it shows the effort that acts, beside a log of the command."""
    rng = np.random.default_rng(4)
    data = {
        "states": {"v": "m/s"},
        "inputs": {"u": "N"},
        "parameters": {"m": {"value": "0.4 kg", "tolerance": "3 %"}, "d": {"value": "0.8 N*s/m", "tolerance": "3 %"}},
        "derivative": {"v": "(u - d*v)/m"},
        "outputs": {"a": "(u - d*v)/m"},
    }
    u, acts, numbers = path(rng, kind)
    fine = acts.repeat(200)
    if kind == "input-lag":
        t, at = np.arange(len(fine)) % 200 * H / 200, u.repeat(200)
        fine = at + (fine - at) * np.exp(-t / 0.06)
    step = H / 200
    v = lfilter([0, step / 0.4], [1, step * 0.8 / 0.4 - 1], fine)[::200]
    a = (acts - 0.8 * v) / 0.4
    config = gc.registry().config("model", "equations").model_validate({"kind": "equations", "period": f"{H} s", **data})
    model = gc.registry().build("model", "equations", config, gc.Context(None))
    shown = a + 0.01 * a.std() * rng.normal(size=N)
    found = gc.diagnose(model, Recording((Trajectory(T, {"a": shown, "u": u}, "log"),), {}, "zero"))
    (cause,) = found.causes
    assert cause.effect == kind or {cause.effect, kind} == {"input-delay", "sensor-delay"}
    for name, value in numbers.items():
        assert cause.parameters[name].value == pytest.approx(value, rel=0.03)


@pytest.mark.exam
def test_a_floor_that_jumps_have_raised_falls_once_the_cause_is_known():
    """A motor's current relaxes within a few samples after each step; only beside a model that fits, what is left is noise."""
    rng = np.random.default_rng(8)
    R, L, K, J = 1.0, 0.012, 0.05, 4e-4
    u = rng.choice([-1, 1], N // 6).repeat(6) * rng.uniform(3, 9, N // 6).repeat(6)
    step, w, i, rows = H / 40, 0.0, 0.0, []
    for value in u.tolist():
        rows.append((w, i))
        for _ in range(40):
            w, i = w + step * K * i / J, i + step * (0.8 * value - R * i - K * w) / L
    w, i = np.array(rows).T
    data = {
        "states": {"w": "rad/s", "i": "A"},
        "inputs": {"u": "V"},
        "parameters": {"R": "1 ohm", "L": "12 mH", "K": "0.05 N*m/A", "J": "4e-4 kg*m^2"},
        "derivative": {"w": "K*i/J", "i": "(u - R*i - K*w)/L"},
    }
    config = gc.registry().config("model", "equations").model_validate({"kind": "equations", "period": f"{H} s", **data})
    model = gc.registry().build("model", "equations", config, gc.Context(None))
    sigma = {"w": 0.01 * w.std(), "i": 0.005 * i.std()}
    shown = {"w": w + sigma["w"] * rng.normal(size=N), "i": i + sigma["i"] * rng.normal(size=N), "u": u}
    found = gc.diagnose(model, Recording((Trajectory(T, shown, "log"),), {}, "zero"))
    assert [c.effect for c in found.causes] == ["input-gain"]
    for name, misfit in found.residual.items():
        assert misfit.noise_floor == pytest.approx(sigma[name], rel=0.2)
