"""The problem codes, from the table in `splatmill.schema.problems`."""

from docs.generate.markdown import code, table

from splatmill.schema import PROBLEMS

INTRODUCTION = """# Error codes

A refused request and a failed job are described by the same document, a problem (RFC 9457) with these fields:

| field | meaning |
| --- | --- |
| `code` | A stable name for programs to decide on. A code never changes its meaning. |
| `detail` | What happened and what was seen, in a sentence. |
| `advice` | What to do about it, where something can be done. |
| `facts` | The numbers and names behind the detail. |
| `title` | The kind of problem, the same for every problem with this code. |
| `status` | The HTTP status of a refused request. A failed job carries the one of its code. |
| `instance` | The request or job that the problem happened to. |
| `type` | `urn:splatmill:problem:` and the code. |

The SDK raises problems as exceptions with the attributes `problem` and `code`
([The errors](../programming/sdk.md#errors)); the command line prints detail, facts and advice, and ends with an
[exit status](command-line.md#exit-status) for the kind of problem.
[Photographing for splats](../photographing.md#when-cameras-fail) explains the codes that photos lead to.

These are all codes:
"""


def page() -> str:
    """The page of problem codes."""
    rows = [[code(name), str(kind.status), kind.title] for name, kind in PROBLEMS.items()]
    return f"{INTRODUCTION}\n{table(['code', 'HTTP status', 'title'], rows)}"
