"""What a run leaves behind: files, figures, page, table and result bag."""
