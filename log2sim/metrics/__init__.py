"""Error figures of a scenario against truth: `evaluate.evaluate`, `truth.truth_from_log`, `table.format_table`."""
