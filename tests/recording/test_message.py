from tfbus.recording import RecordedMessage


def test_a_message_is_its_log_time_its_transforms_and_its_errors() -> None:
    assert RecordedMessage._fields == ("received", "batch", "errors")
