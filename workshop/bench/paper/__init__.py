"""The paper's evaluation (section IV) on this machine, as one report with figures and the data they are drawn from.

`steps`: what is measured, by the other benchmarks, each result a file. `published`: the paper's own values. `series`:
results into the data of figures. `draw`: those into SVG. `report`: all of it on one page. Doors: `run`.
"""

from workshop.bench.paper.report import run

__all__ = ["run"]
