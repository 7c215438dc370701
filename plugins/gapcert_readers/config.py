"""Options of the readers."""

from pathlib import Path
from typing import Literal, Self, final

from pydantic import Field, model_validator

from gapcert.plugin import Seconds, Section


class Log(Section):
    """Measurements in files.

    files: relative to the spec, with * allowed in the last part; columns: channel of the model → column; units: column →
    unit, where it is not the model's; hold: how the inputs go on between samples; every: the period to resample to.
    """

    files: list[str] = Field(min_length=1, description="relative to the spec, with * allowed in the last part")
    columns: dict[str, str] = Field(min_length=1, description="channel of the model (output or input) → column of the log")
    units: dict[str, str] = Field({}, description="column → unit, where it is not the model's")
    hold: Literal["zero", "first"] | None = Field(
        None, description="between samples, is an input held (zero) or a straight line (first)? default: not known"
    )
    every: Seconds | None = Field(None, description="period to resample to, such as 4 ms; default: as it is")

    def paths(self) -> list[tuple[tuple[str | int, ...], Path]]:
        return [(("files", i), Path(file)) for i, file in enumerate(self.files)]

    def channels(self) -> tuple[str, dict[str, str]]:
        return "columns", self.columns

    def resampled(self) -> str:
        return "" if self.every is None else "every"


class Table(Log):
    """Files with named columns; `name[i]` is one column of a two-dimensional one.

    time: the column of times, in s unless `units` says otherwise; period: of the rows, where no column has the time;
    trajectory: a column whose value changes from one trajectory to the next.
    """

    time: str = Field("t", description="the column of times, in s unless `units` says otherwise")
    period: Seconds | None = Field(None, description="of the rows, such as 4 ms, where no column has the time")
    trajectory: str | None = Field(None, description="a column whose value changes from one trajectory to the next")

    @model_validator(mode="after")
    def _timed_once(self) -> Self:
        if self.period is not None and "time" in self.model_fields_set:
            raise ValueError(f"found time: {self.time} and a period; expected one of them: rows have times, or are counted")
        return self


class Messages(Log):
    """Logs of messages by topic; a column is `/topic.field.field[i]`, with a name in the brackets where the message has names.

    The topic of the first column gives the times; others are interpolated to them, or, for channels in `held`, keep their
    value until the next message. clock: the stamp in a message's header where it has one, or the time at which it was logged.
    """

    clock: Literal["message", "log"] = Field(
        "message", description="the stamp in a message's header, or the time at which it was logged"
    )
    held: list[str] = Field([], description="channels that keep their last value; the others are interpolated")


@final
class Csv(Table):
    """Text with a header and a row per line; commas, semicolons, tabs or blanks between the values, as the file has it.

    With semicolons or tabs the decimal sign may be a comma. What is empty, `NA` or `NaN` is a missing value. Text is in UTF-8,
    or else taken for Latin-1. What stands above the header is passed over; a header may stand behind #.
    """

    kind: Literal["csv"] = "csv"


@final
class Parquet(Table):
    """Apache Parquet."""

    kind: Literal["parquet"] = "parquet"


@final
class Hdf5(Table):
    """HDF5; a column is the path of a data set. groups: a pattern such as `data/demo_*`, each group one trajectory."""

    kind: Literal["hdf5"] = "hdf5"
    groups: str | None = Field(None, description="a pattern such as `data/demo_*`; each group is one trajectory")


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
    time: str = Field("timestamp", description="the column of times")
    trajectory: str | None = Field("episode_index", description="the column that numbers the episodes")
    episodes: list[int] | None = Field(default=None, min_length=1, description="the episodes that are read; default: all")


@final
class Mcap(Messages):
    """MCAP with messages of ROS 2, ROS 1 or JSON."""

    kind: Literal["mcap"] = "mcap"


@final
class Rosbag2(Messages):
    """ROS 2 bags; files are their folders."""

    kind: Literal["rosbag2"] = "rosbag2"
