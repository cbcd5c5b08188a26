"""Messages of the errors that users read."""

from servobench.plant.contract.faults import MAX_LENGTH, ConfigurationError


def test_a_long_text_is_shortened_in_the_middle_of_a_message():
    message = str(ConfigurationError(f"title must be short, got '{'a' * 10**6}'; write less"))
    assert len(message) <= MAX_LENGTH + 5
    assert message.startswith("title must be short, got 'aaa")
    assert message.endswith("aaa'; write less")
    assert str(ConfigurationError("a" * MAX_LENGTH)) == "a" * MAX_LENGTH
