"""Tasks that a user asks for, the context that they run in, and runs of several tasks."""
