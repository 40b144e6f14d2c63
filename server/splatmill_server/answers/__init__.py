"""What several endpoints answer with: files in ranges, streams of events, the pictures of the renderer, a web page."""
