"""What each step of `prepare` does: it reads the scene folder so far, writes files, names them in the manifest, returns its record."""
