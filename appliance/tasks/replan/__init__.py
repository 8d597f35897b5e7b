"""What is done about a subtask that was given up: pure decisions, cheapest first.

Retrying elsewhere comes before all this (`machine.gives_up`, `placement`). Then `robots` (another robot), `skills` (an
alternative skill) and the decomposer (`splice` fits its plan to what is finished and under way); `decide` holds the
order. The shell is `tasks.replanning`, the rules that every revision must keep are in `tasks.revising`.
"""
