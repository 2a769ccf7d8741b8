"""Scenario engineering: tags, queries over many scenarios, logical scenarios and their variations.

Nothing is imported here, so that a query loads no tagging.
"""
