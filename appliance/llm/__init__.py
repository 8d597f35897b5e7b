"""Instruction to validated plan: prompt, local slot, upstream, rules, cascade."""
