"""Pictures, films, the bird's-eye view and the page for browsers."""
