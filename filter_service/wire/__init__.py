"""Fields, requests and replies of the messages, one kind each."""
