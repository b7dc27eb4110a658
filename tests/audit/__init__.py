"""What the tests cost and catch: durations, coverage and deliberate faults."""
