"""The bench as a service: jobs, a REST API, server-sent events and pages. Needs the extra ``hbr-rig[web]``."""
