"""Commands that measure and draw: plot, diagnose, saliency, report."""

import argparse
import json
import shutil
import sys
from pathlib import Path

from sb3_por.commands.command import Command, load_model_and_environment, model_arguments, seed
from sb3_por.common.errors import UserError


def _plot_arguments(parser: argparse.ArgumentParser) -> None:
    from sb3_por.analysis.names import FIGURES, METRICS, ORDER

    parser.add_argument("paths", nargs="+", metavar="RUN_OR_FOLDER", help="runs, folders of runs, or tables of scores (.csv)")
    output = "the figure: .png, .pdf or .svg; .csv: its numbers; with --kind all a folder for every figure in all formats"
    parser.add_argument("-o", "--output", required=True, help=output)
    kinds = f"which figure (default iqm); {ORDER}: loss and accuracy of POR's classifier, from the runs' TensorBoard files"
    parser.add_argument("--kind", choices=[*FIGURES, ORDER, "all"], default="iqm", help=kinds)
    parser.add_argument("--metric", choices=METRICS, default=METRICS[0], help=f"what to plot (default {METRICS[0]})")
    step = "compare at this step, and leave out runs that end before (default: the end of the shortest run)"
    parser.add_argument("--step", type=int, help=step)
    parser.add_argument("--csv", help="write the table of scores here, too")
    parser.add_argument("--seed", type=seed, default=0, help="seed of the bootstrap (default 0)")


def _plot(args: argparse.Namespace) -> None:
    from sb3_por.analysis import figures
    from sb3_por.analysis.por_logs import read_order, write_order
    from sb3_por.analysis.scores import is_table, read_scores, write_csv
    from sb3_por.common.files import check_output, check_writable

    if args.kind == "all":
        check_writable(args.output)
    else:
        check_output(args.output, figures.SUFFIXES)
    if args.csv:
        check_output(args.csv, (".csv",))
    if args.kind == figures.ORDER:
        if args.step is not None:
            raise UserError(f"--step is where scores are compared; --kind {figures.ORDER} shows all of training")
        order, left_out = read_order(args.paths)
        _print_notes(left_out)
        plot, notes = figures.plot_order(order)
        plot.save(args.output)
    else:
        scores = read_scores(args.paths)
        how = {"metric": args.metric, "step": args.step, "seed": args.seed}
        if args.kind == "all":
            order, left_out = read_order(path for path in args.paths if not is_table(Path(path)))
            plots, notes = figures.plot_all(scores, order, **how)
            notes = [*left_out, *notes]
            figures.save_all(plots, args.output)
        else:
            plot, notes = figures.plot(scores, args.kind, **how)
            plot.save(args.output)
    _print_notes(notes)
    if args.csv:
        write_order(order, args.csv) if args.kind == figures.ORDER else write_csv(scores, args.csv)
    print(args.output)


def _print_notes(notes: list[str]) -> None:
    for note in notes:
        print(f"note: {note}", file=sys.stderr)


def _diagnose_arguments(parser: argparse.ArgumentParser) -> None:
    runs = "instead of --model and --env: make a table of the last models of all runs in there that learn an order"
    parser.add_argument("paths", nargs="*", metavar="RUN_OR_FOLDER", help=runs)
    parser.add_argument("--csv", help="write that table here, too")
    model_arguments(parser, required=False)
    parser.add_argument("-n", "--n-episodes", type=int, default=5, help="held-out episodes of each policy (default 5)")
    fresh = "also train fresh heads on the frozen encoder, on an untrained one, and with sham labels, as controls"
    parser.add_argument("--fresh-head", action="store_true", help=fresh)
    parser.add_argument("--seed", type=seed, default=0, help="seed of the first episode (default 0)")
    parser.add_argument("--json", action="store_true", help="print everything as JSON")


def _diagnose(args: argparse.Namespace) -> None:
    from sb3_por.analysis.diagnostics import check_order, diagnose, diagnose_runs
    from sb3_por.common.files import atomic_write, check_output

    if args.csv:
        check_output(args.csv, (".csv",))
    named = [args.model, args.pretrained, args.env, args.algo]
    one = (args.model or args.pretrained) and args.env
    if not (args.paths or one) or (args.paths and any(named)) or (args.csv and not args.paths):
        raise UserError("give --model and --env, or folders of runs and perhaps --csv (diagnose --help lists the arguments)")
    if args.paths:
        table = diagnose_runs(args.paths, args.n_episodes, args.seed, args.fresh_head, args.safe)
        if args.csv:
            with atomic_write(args.csv) as path:
                table.to_csv(path, index=False, float_format="%.5g")
        # The file has a row a run; there are too many measurements for one line
        shown = table.round(3).T.to_string(header=False, line_width=shutil.get_terminal_size().columns)
        print(table.to_json(orient="records", indent=2) if args.json else shown)
        return
    model, environment = load_model_and_environment(args)
    check_order(model)
    diagnosis = diagnose(model, args.env, args.n_episodes, args.seed, **environment, fresh_head=args.fresh_head)
    if args.json:
        print(json.dumps({"model": str(args.model), "env": args.env, "seed": args.seed, **diagnosis.as_dict()}, indent=2))
    else:
        print(diagnosis)


def _saliency_arguments(parser: argparse.ArgumentParser) -> None:
    model_arguments(parser)
    parser.add_argument("-o", "--output", required=True, help="the picture: .png or .jpg")
    parser.add_argument("--step", type=int, help="number of the frame (default: where the monotone quantity rises most)")
    parser.add_argument("--seed", type=seed, default=0, help="seed of the episode (default 0)")


def _saliency(args: argparse.Namespace) -> None:
    from sb3_por.analysis.saliency import draw_saliency

    model, environment = load_model_and_environment(args)
    step = draw_saliency(model, args.env, args.output, args.step, args.seed, **environment)
    print(f"step {step}: {args.output}")


def _report_arguments(parser: argparse.ArgumentParser) -> None:
    from sb3_por.analysis.names import METRICS

    parser.add_argument("paths", nargs="+", metavar="RUN_OR_FOLDER", help="runs, folders of runs, or tables of scores (.csv)")
    parser.add_argument("-o", "--output", required=True, help="folder that gets index.html, and figures/ for print")
    parser.add_argument("--metric", choices=METRICS, help="what to compare (default: the first that is recorded)")
    step = "compare at this step, and leave out runs that end before (default: the end of the shortest run)"
    parser.add_argument("--step", type=int, help=step)
    parser.add_argument("--no-videos", action="store_true", help="leave out videos and saliency maps: much quicker")
    parser.add_argument("--seed", type=seed, default=0, help="seed of the bootstrap (default 0)")


def _report(args: argparse.Namespace) -> None:
    import softbody_envs  # noqa: F401  (registers its ids)
    from sb3_por.analysis.report import write_report

    print(write_report(args.paths, args.output, args.metric, args.step, args.seed, videos=not args.no_videos))


COMMANDS = {
    "plot": Command(
        help="draw learning curves and comparisons with 95 %% stratified bootstrap intervals",
        example="logs/sac_por logs/sac_drq --kind tasks -o tasks.pdf --csv scores.csv",
        add_arguments=_plot_arguments,
        run=_plot,
    ),
    "diagnose": Command(
        help="measure what a model's classifier has learned: order, or which encoder it looks at",
        example="--model logs/sac_por/PourWater-v0_1 --env PourWater-v0",
        add_arguments=_diagnose_arguments,
        run=_diagnose,
    ),
    "saliency": Command(
        help="draw which pixels the classifier looks at",
        example="--model logs/sac_por/PourWater-v0_1 --env PourWater-v0 -o map.png",
        add_arguments=_saliency_arguments,
        run=_saliency,
    ),
    "report": Command(
        help="write a page with what a set of runs was and has shown: figures, tables, videos, settings, failures",
        example="runs/smoke -o report",
        add_arguments=_report_arguments,
        run=_report,
    ),
}
