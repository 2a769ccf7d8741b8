"""Log2sim's own log folders: reader and writer."""
