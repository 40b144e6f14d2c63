"""What every floor above builds on: settings, problems, lists, leases, and requests to others."""
