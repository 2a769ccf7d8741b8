"""Writers of log formats for tests: each writes a log with exact truth, by the published description of the format."""
