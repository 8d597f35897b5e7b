"""How many subtasks a second a fleet places and finishes, where its time goes, and how soon it goes on after a kill."""
