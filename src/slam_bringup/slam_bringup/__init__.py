"""Launch files, configuration, the offline pipeline, bag tools and the slam command line."""
