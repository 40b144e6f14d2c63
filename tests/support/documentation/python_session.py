"""One Python session over several blocks: each line of standard input is a block as JSON, and is answered by one line.

Started as a program by `tests.support.documentation.reader`, so that a page's blocks share their names and nothing of
the test's.
"""

import contextlib
import io
import json
import sys
import traceback

answers = sys.stdout
names: dict[str, object] = {"__name__": "__main__"}
for line in sys.stdin:
    printed = io.StringIO()
    status = 0
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            exec(compile(json.loads(line), "<block>", "exec"), names)
        except Exception:
            traceback.print_exc()
            status = 1
    print(json.dumps({"status": status, "printed": printed.getvalue()}), file=answers, flush=True)
