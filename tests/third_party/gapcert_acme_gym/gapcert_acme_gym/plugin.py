"""What this package offers; gymnasium itself is imported when the backend is used."""

import gapcert as gc


@gc.hookimpl
def gapcert_components():
    return [
        gc.Component(
            "backend",
            "gymnasium-pendulum",
            "Pendulum-v1 of gymnasium: upright at 0, torque and speed limited",
            "gapcert_acme_gym.backend:GymPendulum",
            config="gapcert_acme_gym.config:GymPendulumConfig",
            requires=("gymnasium",),
            install="pip install gymnasium",
        )
    ]
