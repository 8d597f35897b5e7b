"""What an instruction asks for, beside its plan: parameters with units, constraints, robots by capability, allocation.

The paper's semantic analysis and its container allocation hints, as facts for people, the terminal UI and pools. Pure.
"""

from appliance.llm.analysis.analyse import Analysis, analyse

__all__ = ["Analysis", "analyse"]
