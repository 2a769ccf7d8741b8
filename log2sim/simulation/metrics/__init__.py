"""What came of a replay: errors, contacts, conflicts, comfort, and the limits that a strict replay keeps."""
