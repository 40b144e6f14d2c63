"""`splatmill up`: the whole service on one machine, as children of one small process.

Redis, the API, one worker and the renderer start side by side, are started anew when they die, and end with this
process, however it ends. What they keep lies in one data folder, so that the next start goes on from there.
"""
