"""`bench openapi`: its page lists what failed. Not proved here: the requests themselves (server/bench/openapi.md)."""

import openapi

REPORT = {
    "valid_rates": {
        "GET /healthz": {
            "fuzzing": {"accepted": 2, "rejected": 0},
            "stateful": {"accepted": 1, "rejected": 1},
        },
        "POST /v1/jobs": {"fuzzing": {"accepted": 0, "rejected": 4}},
    }
}
ROW = {
    "requests": 11,
    "operations": 2,
    "rounds": 1,
    "seconds": 3.0,
    "outcomes": {"accepted": 3, "rejected": 5},
    "failures": [],
    "errors": [],
    "unexpected": [],
    "ready": True,
    "grown_bytes": 2_000_000,
    "machine": "one",
    "versions": {"python": "3"},
    "commit": "abc",
}


def test_outcomes_are_summed_over_operations_and_phases() -> None:
    assert openapi._outcomes([REPORT, REPORT]) == {"accepted": 6, "rejected": 10}


def test_the_page_names_failed_checks() -> None:
    page = openapi.STUDY.page([ROW])
    assert "11 requests to 2 operations in 1 rounds, 3 seconds: 0 failed checks" in page
    assert "| refused for their content | 5 |" in page
    assert "failed check |" not in page
    failure = {"title": "Server error", "code": "ST100", "count": 2, "operations": ["GET /v1/jobs"]}
    assert "| Server error (ST100) | 2 | `GET /v1/jobs` |" in openapi.outcomes(
        [{**ROW, "failures": [failure]}]
    )
