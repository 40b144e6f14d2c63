"""The tables of `bench capacity`, from its rows."""

from _page import Column, of_rows
from _rows import Row, footer


def sections(rows: list[Row]) -> str:
    """A section for each number of records, the largest first, those in a folder before those on S3."""
    sorts = sorted({_sort(row) for row in rows}, key=lambda sort: (sort[1], -sort[0]))
    return "\n\n".join(_section(*sort, [row for row in rows if _sort(row) == sort]) for sort in sorts)


def _sort(row: Row) -> tuple[int, str]:
    """The number of records of a row, and where they were stored: in a folder, if it does not say."""
    return row["records"], row.get("storage_in", "folder")


PAGE: list[Column] = [
    ("a page of 50", "{list}: {where}"),
    ("ms:", lambda row: f"{1000 * row['seconds']:.0f}"),
    ("CPU ms:", lambda row: f"{1000 * row['cpu_seconds']:.0f}" if "cpu_seconds" in row else ""),
    ("round trips:", "{round_trips}"),
    ("storage:", "{storage}"),
    ("found:", "{found}"),
    ("ms at first:", lambda row: f"{1000 * row['first_seconds']:.0f}"),
    ("storage at first:", "{first_storage}"),
]
TIMES: list[Column] = [
    ("what", "{what}"),
    ("seconds:", "{seconds:.2f}"),
    ("round trips:", lambda row: row.get("round_trips", "")),
    ("storage:", lambda row: row.get("storage", "")),
]


def _section(count: int, storage: str, rows: list[Row]) -> str:
    memory: list[Column] = [
        ("Redis", "{what}"),
        ("MB:", lambda row: f"{row['bytes'] / 1e6:.0f}"),
        ("bytes for each job, with its capture and model:", lambda row: f"{row['bytes'] / count:.0f}"),
    ]
    pages = [row for row in rows if row["what"] == "page"]
    timed = [row for row in rows if row["what"] != "page" and "seconds" in row and "followers" not in row]
    timed += [
        {"what": f"{row['what']}, to the first page", "seconds": row["first_page"]}
        for row in rows
        if "first_page" in row
    ]
    where = "" if storage == "folder" else ", on S3"
    return "\n\n".join(
        [
            f"## {count} captures, {count} jobs, about {0.89 * count:.0f} models{where}",
            *([of_rows(PAGE, pages)] if pages else []),
            of_rows(TIMES, timed),
            of_rows(memory, [row for row in rows if "bytes" in row]),
            *(
                f"{row['followers']} clients followed one job: {row['told_everything']} were told everything. The "
                f"{row['event_seconds']:.0f} seconds of events took {row['seconds']:.1f} s with connecting, "
                f"{row['cpu_seconds']:.1f} CPU seconds of the API process and {row['bytes_each'] / 1000:.0f} kB for "
                f"each client; Redis had {row['redis_connections']} connections."
                for row in rows
                if "followers" in row
            ),
            footer(rows),
        ]
    )
