"""What a user asks for: tasks, the context they run in, and a run of several of them."""
