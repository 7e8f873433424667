"""What every room uses: clock, errors, files, processes."""
