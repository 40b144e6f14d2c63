"""`splatmill up`: the embedded service, which is the whole service on one machine under one supervisor.

Redis, the API, one worker and the renderer are child processes. They are restarted when they die, and end with the
supervisor, however it ends. Their data lies in one folder, from which the next start continues.
"""
