"""Given cameras and points judged by the photos: which of them their matches and colours confirm."""
