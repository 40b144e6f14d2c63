"""`splatmill webhooks`: creates, lists and deletes webhooks, and shows what was delivered."""

from typing import TYPE_CHECKING, Annotated

import typer

from splatmill.cli.display.tables import JsonLines, print_lines
from splatmill.cli.servers import ServerOption, open_client

if TYPE_CHECKING:
    from splatmill.schema import WebhookWithSecret

webhooks = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Let the server tell an address when jobs end.",
)

WebhookId = Annotated[str, typer.Argument(metavar="WEBHOOK", help="Id of the webhook.", show_default=False)]


@webhooks.command()
def create(
    url: Annotated[str, typer.Argument(help="Address that receives the POST requests.", show_default=False)],
    event: Annotated[
        list[str] | None,
        typer.Option(
            help="job.succeeded, job.failed or job.cancelled; may be repeated. Left out, all of them."
        ),
    ] = None,
    name: Annotated[str | None, typer.Option(help="What people call the webhook.")] = None,
    server: ServerOption = None,
) -> None:
    """Create a webhook, and print its secret, which the server cannot show again."""
    with open_client(server) as client:
        _show(client.webhooks.create(url, events=event or None, name=name))


@webhooks.command("list")
def list_webhooks(server: ServerOption = None, as_json: JsonLines = False) -> None:
    """List the webhooks, the oldest first, without their secrets."""
    with open_client(server) as client:
        listed = client.webhooks.list()
    if as_json:
        print_lines(listed)
        return
    if not listed:
        typer.echo("There are no webhooks. Create one with: splatmill webhooks create URL")
        return
    for webhook in listed:
        events = ", ".join(event.value.removeprefix("job.") for event in webhook.events)
        typer.echo(f"{webhook.id}  {webhook.url}  {events}" + (f"  {webhook.name}" if webhook.name else ""))
        if webhook.disabled_reason is not None:
            typer.echo(f"  disabled: {webhook.disabled_reason}")


@webhooks.command()
def delete(webhook_id: WebhookId, server: ServerOption = None) -> None:
    """Delete a webhook and its log."""
    with open_client(server) as client:
        client.webhooks.delete(webhook_id)
    typer.echo(f"The webhook {webhook_id} is deleted.")


@webhooks.command()
def rotate(webhook_id: WebhookId, server: ServerOption = None) -> None:
    """Give a webhook a new secret. For 24 hours, requests are signed with the former one too."""
    with open_client(server) as client:
        _show(client.webhooks.rotate(webhook_id))


@webhooks.command()
def enable(webhook_id: WebhookId, server: ServerOption = None) -> None:
    """Send to a disabled webhook again."""
    with open_client(server) as client:
        client.webhooks.enable(webhook_id)
    typer.echo(f"The webhook {webhook_id} is enabled.")


@webhooks.command()
def deliveries(webhook_id: WebhookId, server: ServerOption = None, as_json: JsonLines = False) -> None:
    """List what was delivered, newest first, with every attempt."""
    with open_client(server) as client:
        deliveries = client.webhooks.deliveries(webhook_id)
    if as_json:
        print_lines(deliveries)
        return
    for delivery in deliveries:
        created = delivery.created_at.astimezone().strftime("%Y-%m-%d %H:%M:%S")
        typer.echo(
            f"{delivery.id}  {created}  {delivery.event.value}  {delivery.job}  {delivery.state.value}"
        )
        for attempt in delivery.attempts:
            outcome = attempt.error if attempt.status is None else f"{attempt.status} {attempt.answer or ''}"
            typer.echo(f"  {attempt.at.astimezone():%Y-%m-%d %H:%M:%S}  {(outcome or '')[:100].strip()}")


@webhooks.command()
def repeat(
    webhook_id: WebhookId,
    delivery_id: Annotated[
        str, typer.Argument(metavar="DELIVERY", help="Id of the delivery.", show_default=False)
    ],
    server: ServerOption = None,
) -> None:
    """Send a delivery that is over once more."""
    with open_client(server) as client:
        client.webhooks.repeat(webhook_id, delivery_id)
    typer.echo(f"The delivery {delivery_id} is sent again.")


def _show(webhook: "WebhookWithSecret") -> None:
    typer.echo(f"webhook {webhook.id}")
    typer.echo(f"secret  {webhook.secret}")
