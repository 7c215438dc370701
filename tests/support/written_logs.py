"""One short motion in every format that a reader knows, and readers of it."""

import json
from functools import cache

import numpy as np
from scipy.io import savemat

import gapcert as gc

T = np.arange(50) * 0.01
ANGLE, TORQUE = np.sin(T), np.cos(3 * T)
START = 1_700_000_000_000_000_000
STAMPS = START + np.round(T * 1e9).astype(np.int64)
TABLES = ("csv", "parquet")


def reader(folder, kind, **options):
    config = gc.registry().config("reader", kind)
    given = {"kind": kind, "files": [f"log.{kind}"], "columns": {"theta": "angle", "u": "torque"}, **options}
    return gc.registry().build("reader", kind, config.model_validate(given), gc.Context(folder))


def table():
    import pyarrow

    return pyarrow.table({"t": T, "angle": ANGLE, "torque": np.arange(50)})


def write_table(kind, path):
    from pyarrow import csv, parquet

    {"csv": csv.write_csv, "parquet": parquet.write_table}[kind](table(), path)


def columns(theta, u):
    return {"columns": {"theta": theta, "u": u}}


def write_hdf5(folder):
    import h5py

    with h5py.File(folder / "log.h5", "w") as file:
        file["run/clock/t"] = T
        file["run/state"] = np.stack([ANGLE, 0 * T], axis=1)
        file["run/torque"] = TORQUE
    return {"files": ["log.h5"], "time": "run/clock/t", **columns("run/state[0]", "run/torque")}


def write_mat(folder):
    savemat(folder / "log.mat", {"t": T[:, None], "x": np.stack([ANGLE, 0 * T], 1), "drive": {"u": TORQUE[None, :]}})
    return {"files": ["log.mat"], **columns("x[0]", "drive.u")}


def write_mat73(folder):
    # As MATLAB does it: HDF5 behind a header of 512 bytes, arrays with their axes turned round, structs as groups.
    import h5py

    with h5py.File(folder / "log.mat", "w", userblock_size=512) as file:
        file["t"] = T[None, :]
        file["x"] = np.stack([ANGLE, 0 * T], 1).T
        file["drive/u"] = TORQUE[:, None].T
        file["#refs#/a"] = T
    with (folder / "log.mat").open("r+b") as file:
        text = b"MATLAB 7.3 MAT-file, Platform: GLNXA64"
        file.write(text.ljust(124) + b"\x00\x02IM")
    return {"files": ["log.mat"], **columns("x[0]", "drive.u")}


def write_lerobot(folder, episodes=1):
    import pyarrow
    from pyarrow import parquet

    root = folder / "set"
    (root / "meta").mkdir(parents=True)
    (root / "data" / "chunk-000").mkdir(parents=True)
    features = {
        "observation.state": {"dtype": "float32", "shape": [2], "names": {"motors": ["elbow", "wrist"]}},
        "action": {"dtype": "float32", "shape": [1], "names": ["torque"]},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    }
    (root / "meta" / "info.json").write_text(json.dumps({"codebase_version": "v2.1", "fps": 100, "features": features}))
    for e in range(episodes):
        state, action = np.stack([ANGLE + e, 0 * T], 1), TORQUE[:, None]
        episode = pyarrow.table(
            {
                "observation.state": pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(state.ravel()), 2),
                "action": pyarrow.array(list(action)),
                "timestamp": T,
                "episode_index": np.full(len(T), e),
                "task": ["lift"] * len(T),
            }
        )
        parquet.write_table(episode, root / "data" / "chunk-000" / f"episode_{e:06d}.parquet")
    return {"files": ["set"], **columns("observation.state[elbow]", "action[0]")}


@cache
def store():
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def joint_state(k, names=("elbow", "wrist")):
    make = store().types
    header = make["std_msgs/msg/Header"](
        make["builtin_interfaces/msg/Time"](int(STAMPS[k] // 10**9), int(STAMPS[k] % 10**9)), "base"
    )
    values = {"elbow": ANGLE[k], "wrist": 0.0}
    position = np.array([values[n] for n in names])
    return make["sensor_msgs/msg/JointState"](header, list(names), position, 0 * position, np.full(2, TORQUE[k]))


JOINTS = {"files": ["log"], **columns("/joint_states.position[elbow]", "/joint_states.effort[0]")}


def write_rosbag2(folder, storage="SQLITE3"):
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as BagWriter

    kind = "sensor_msgs/msg/JointState"
    with BagWriter(folder / "log", version=9, storage_plugin=StoragePlugin[storage]) as bag:
        connection = bag.add_connection("/joint_states", kind, typestore=store())
        for k in range(len(T)):
            # The order of the joints may change from message to message.
            message = joint_state(k, ("elbow", "wrist") if k % 2 else ("wrist", "elbow"))
            bag.write(connection, int(STAMPS[k]) + 3_000_000, store().serialize_cdr(message, kind))
    return JOINTS


def write_mcap_ros(folder):
    from mcap.writer import Writer as McapWriter

    name, kind = "sensor_msgs/msg/JointState", "sensor_msgs/msg/JointState"
    with (folder / "log.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        schema = writer.register_schema(name, "ros2msg", store().generate_msgdef(kind, ros_version=2)[0].encode())
        channel = writer.register_channel("/joint_states", "cdr", schema)
        for k in range(len(T)):
            data = bytes(store().serialize_cdr(joint_state(k), kind))
            writer.add_message(channel, int(STAMPS[k]) + 3_000_000, data, int(STAMPS[k]))
        writer.finish()
    return {**JOINTS, "files": ["log.mcap"]}


def write_mcap_json(folder, torque=None, values=None):
    from mcap.writer import Writer as McapWriter

    torque, values = STAMPS if torque is None else torque, TORQUE if values is None else values
    with (folder / "log.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        schema = writer.register_schema("any", "jsonschema", b'{"type": "object"}')
        state = writer.register_channel("/arm/state", "json", schema)
        drive = writer.register_channel("/arm/drive", "json", schema)
        for k in range(len(T)):
            writer.add_message(state, int(STAMPS[k]), json.dumps({"joints": [{"q": ANGLE[k]}], "ok": True}).encode(), 0)
        for at, value in zip(torque.tolist(), values.tolist(), strict=True):
            writer.add_message(drive, at, json.dumps({"torque": value}).encode(), 0)
        writer.finish()
    return {"files": ["log.mcap"], **columns("/arm/state.joints[0].q", "/arm/drive.torque")}


FORMATS = {
    "hdf5": ("hdf5", write_hdf5),
    "mat": ("mat", write_mat),
    "mat-7.3": ("mat", write_mat73),
    "lerobot": ("lerobot", write_lerobot),
    "rosbag2-sqlite": ("rosbag2", write_rosbag2),
    "rosbag2-mcap": ("rosbag2", lambda folder: write_rosbag2(folder, "MCAP")),
    "mcap-ros2": ("mcap", write_mcap_ros),
    "mcap-json": ("mcap", write_mcap_json),
}
