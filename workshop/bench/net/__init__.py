"""A network of its own for a fleet on one machine: a namespace for each gateway, and a wire that can be made bad."""
