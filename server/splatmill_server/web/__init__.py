"""The web page: files of `page/`, third-party JavaScript of `vendor/`, and the policy that browsers are given."""
