"""Declares what this package offers; imports nothing but gapcert."""

import gapcert


@gapcert.hookimpl
def gapcert_components() -> list[gapcert.Component]:
    return [
        gapcert.Component(
            "backend",
            "gazebo",
            "Gazebo's own physics (dartsim) from an SDF world, in a loop of C++",
            "gapcert_gazebo.engine:GazeboEngine",
            config="gapcert_gazebo.config:GazeboConfig",
            check="gapcert_gazebo.system:absent",
            install="apt-get install -y --no-install-recommends g++ pkg-config libignition-physics-core-dev"
            " libignition-physics-sdf-dev libignition-physics5-dartsim-plugin5 libignition-plugin-dev libsdformat-dev"
            " libeigen3-dev",
        )
    ]
