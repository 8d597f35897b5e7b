"""The rival's side: runs in the environment of `make flower`, and imports nothing of the product but its handlers."""
