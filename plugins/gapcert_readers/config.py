"""Options of the readers."""

from typing import Annotated, Literal, final

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, WithJsonSchema

import gapcert as gc


def _seconds(value: object) -> float:
    if (seconds := gc.magnitude(value, "s")) <= 0:
        raise ValueError(f"found {value!r}; expected a positive time")
    return seconds


Seconds = Annotated[float, BeforeValidator(_seconds), WithJsonSchema({"type": ["number", "string"], "quantity": "s"})]


class Log(BaseModel):
    """Measurements in files.

    files: relative to the spec, with * allowed in the last part; columns: channel of the model → column; units: column →
    unit, where it is not the model's; hold: how the inputs go on between samples; every: the period to resample to.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    files: list[str] = Field(min_length=1)
    columns: dict[str, str] = Field(min_length=1)
    units: dict[str, str] = {}
    hold: Literal["zero", "first"] | None = None
    every: Seconds | None = None


class Table(Log):
    """Files with named columns; `name[i]` is one column of a two-dimensional one.

    time: the column of times, in s unless `units` says otherwise; period: of the rows, where no column has the time;
    trajectory: a column whose value changes from one trajectory to the next.
    """

    time: str = "t"
    period: Seconds | None = None
    trajectory: str | None = None


class Messages(Log):
    """Logs of messages by topic; a column is `/topic.field.field[i]`, with a name in the brackets where the message has names.

    The topic of the first column gives the times; others are interpolated to them, or, for channels in `held`, keep their
    value until the next message. clock: the stamp in a message's header where it has one, or the time at which it was logged.
    """

    clock: Literal["message", "log"] = "message"
    held: list[str] = []


@final
class Csv(Table):
    """Comma-separated text with a header."""

    kind: Literal["csv"] = "csv"


@final
class Parquet(Table):
    """Apache Parquet."""

    kind: Literal["parquet"] = "parquet"


@final
class Hdf5(Table):
    """HDF5; a column is the path of a data set. groups: a pattern such as `data/demo_*`, each group one trajectory."""

    kind: Literal["hdf5"] = "hdf5"
    groups: str | None = None


@final
class Mat(Table):
    """MATLAB's .mat, version 5 to 7.3; a column is a variable, `struct.field` in a struct."""

    kind: Literal["mat"] = "mat"


@final
class Lerobot(Table):
    """LeRobot data sets (version 2 or 3); files are their folders, every episode is a trajectory.

    A column is a feature with an index or one of its names: `observation.state[0]`, `action[elbow]`.
    """

    kind: Literal["lerobot"] = "lerobot"
    time: str = "timestamp"
    trajectory: str | None = "episode_index"
    episodes: list[int] | None = Field(default=None, min_length=1)


@final
class Mcap(Messages):
    """MCAP with messages of ROS 2, ROS 1 or JSON."""

    kind: Literal["mcap"] = "mcap"


@final
class Rosbag2(Messages):
    """ROS 2 bags; files are their folders."""

    kind: Literal["rosbag2"] = "rosbag2"
