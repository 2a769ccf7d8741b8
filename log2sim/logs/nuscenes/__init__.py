"""nuScenes: tables, sweeps and annotations of version 1.0."""
