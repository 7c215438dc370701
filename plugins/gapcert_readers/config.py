"""Options of the readers."""

from typing import Literal, final

from pydantic import BaseModel, ConfigDict, Field


class _Table(BaseModel):
    """Files with named columns.

    files: relative to the spec; time: the column of times in s; columns: channel of the model → column; units: column → unit,
    where it is not the model's; trajectory: a column whose value changes from one trajectory to the next.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    files: list[str] = Field(min_length=1)
    time: str = "t"
    columns: dict[str, str] = Field(min_length=1)
    units: dict[str, str] = {}
    trajectory: str | None = None


@final
class Csv(_Table):
    """Comma-separated text with a header."""

    kind: Literal["csv"] = "csv"


@final
class Parquet(_Table):
    """Apache Parquet."""

    kind: Literal["parquet"] = "parquet"
