"""The tables of `bench capacity`, from its rows."""

from collections.abc import Sequence
from pathlib import Path

from _rows import Row, footer, lines

HEAD = """# Capacity

What captures, jobs and models cost the service in their thousands, and clients that follow events. `splatmill bench
capacity` writes the rows (`results/capacity.jsonl`) and this page. Storage is a folder, unless S3 is named: then it is
moto's server. Redis and the API are processes on the machine named below. Operations of storage are calls: a listing
counts once. CPU is that of the API for one page, which other programs on the machine change less than its time.
"""


def write_table(rows_at: Path, page: Path) -> None:
    """Write the page for the newest rows of each number of records, the largest number first."""
    newest: dict[tuple[object, ...], Row] = {}
    for row in lines(rows_at):
        newest[_sort(row), row["what"], row.get("list"), row.get("where")] = row
    sorts = sorted({_sort(row) for row in newest.values()}, key=lambda sort: (sort[1], -sort[0]))
    if sorts:
        text = [HEAD]
        for sort in sorts:
            text += _section(*sort, [row for row in newest.values() if _sort(row) == sort])
        page.write_text("\n".join(text))


def _sort(row: Row) -> tuple[int, str]:
    """Return the number of records of a row, and where they were stored: in a folder, if it does not say."""
    return row["records"], row.get("storage_in", "folder")


def _section(count: int, storage: str, rows: Sequence[Row]) -> list[str]:
    where = "" if storage == "folder" else ", on S3"
    text = [f"## {count} captures, {count} jobs, about {0.89 * count:.0f} models{where}", ""]
    if any(row["what"] == "page" for row in rows):
        text += [
            "| a page of 50 | ms | CPU ms | round trips | storage | found | ms at first | storage at first |"
        ]
        text += ["|---|---:|---:|---:|---:|---:|---:|---:|"]
    text += [
        f"| {row['list']}: {row['where']} | {1000 * row['seconds']:.0f} | {_cpu(row)} "
        f"| {row['round_trips']} | {row['storage']} | {row['found']} "
        f"| {1000 * row['first_seconds']:.0f} | {row['first_storage']} |"
        for row in rows
        if row["what"] == "page"
    ]
    text += ["", "| what | seconds | round trips | storage |", "|---|---:|---:|---:|"]
    text += [
        f"| {row['what']} | {row['seconds']:.2f} | {row.get('round_trips', '')} | {row.get('storage', '')} |"
        for row in rows
        if row["what"] != "page" and "seconds" in row and "followers" not in row
    ]
    text += [
        f"| {row['what']}, to the first page | {row['first_page']:.2f} | | |"
        for row in rows
        if "first_page" in row
    ]
    text += ["", "| Redis | MB | bytes for each job, with its capture and model |", "|---|---:|---:|"]
    text += [
        f"| {row['what']} | {row['bytes'] / 1e6:.0f} | {row['bytes'] / count:.0f} |"
        for row in rows
        if "bytes" in row
    ]
    text += [
        f"\n{row['followers']} clients followed one job: {row['told_everything']} were told everything. The "
        f"{row['event_seconds']:.0f} seconds of events took {row['seconds']:.1f} s with connecting, "
        f"{row['cpu_seconds']:.1f} CPU seconds of the API process and {row['bytes_each'] / 1000:.0f} kB for each "
        f"client; Redis had {row['redis_connections']} connections."
        for row in rows
        if "followers" in row
    ]
    return [*text, "", footer(list(rows)), ""]


def _cpu(row: Row) -> str:
    """Return the CPU milliseconds of a page, if they were measured."""
    return f"{1000 * row['cpu_seconds']:.0f}" if "cpu_seconds" in row else ""
