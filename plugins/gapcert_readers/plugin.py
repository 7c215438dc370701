"""Declares what this package offers; imports nothing but gapcert."""

import gapcert


@gapcert.hookimpl
def gapcert_components() -> list[gapcert.Component]:
    return [
        gapcert.Component("reader", name, summary, f"gapcert_readers.tables:{title}Reader", f"gapcert_readers.config:{title}")
        for name, title, summary in (
            ("csv", "Csv", "comma-separated text with a header"),
            ("parquet", "Parquet", "Apache Parquet"),
        )
    ]
