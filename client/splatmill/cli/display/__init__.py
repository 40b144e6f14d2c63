"""What commands print: tables, the plan and the progress of a job, and transfers."""
