"""What makes two requests for a job the same one."""

from splatmill.schema import CreateJob, TrainOptions


def test_a_request_is_the_same_to_a_version_with_more_options() -> None:
    assert CreateJob(capture="c").described() == '{"capture":"c"}'
    options = TrainOptions(steps=5)
    assert CreateJob(capture="c", name="n", options=options).described(with_capture=False) == (
        '{"name":"n","options":{"steps":5}}'
    )
