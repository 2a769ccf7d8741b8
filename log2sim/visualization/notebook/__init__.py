"""What a notebook shows of logs, scenarios and replays."""
