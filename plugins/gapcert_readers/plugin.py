"""Declares what this package offers; imports nothing but gapcert."""

import gapcert

_READERS = (
    ("csv", "tables:CsvReader", "Csv", "comma-separated text with a header", ()),
    ("parquet", "tables:ParquetReader", "Parquet", "Apache Parquet", ()),
    ("hdf5", "arrays:Hdf5Reader", "Hdf5", "HDF5", ("h5py",)),
    ("mat", "arrays:MatReader", "Mat", "MATLAB's .mat, versions 5 to 7.3", ("h5py",)),
    ("lerobot", "tables:LerobotReader", "Lerobot", "LeRobot data sets", ()),
    ("mcap", "messages:McapReader", "Mcap", "MCAP with messages of ROS or JSON", ("mcap", "rosbags")),
    ("rosbag2", "messages:Rosbag2Reader", "Rosbag2", "ROS 2 bags", ("rosbags",)),
)


@gapcert.hookimpl
def gapcert_components() -> list[gapcert.Component]:
    readers = [
        gapcert.Component(
            "reader",
            name,
            summary,
            f"gapcert_readers.{target}",
            f"gapcert_readers.config:{config}",
            requires=requires,
            extra="readers" if requires else "",
        )
        for name, target, config, summary, requires in _READERS
    ]
    contract = "gapcert_recordings.testing:ReaderContract"
    return [gapcert.Component("contract", "ReaderContract", "what every reader keeps", contract), *readers]
