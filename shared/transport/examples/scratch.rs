use carff_messages::{DatasetView, FrameMeta, Header, Intrinsics};
use carff_transport::{Input, Node, Run, monotonic_now_ns, topics};
use std::hint::black_box;
use std::time::Instant;
fn time(name: &str, n: u32, mut f: impl FnMut()) {
    let mut best = f64::MAX;
    let mut all = vec![];
    for _ in 0..200 {
        let t = Instant::now();
        for _ in 0..n { f(); }
        let v = t.elapsed().as_nanos() as f64 / f64::from(n);
        best = best.min(v);
        all.push(v);
    }
    all.sort_by(f64::total_cmp);
    println!("{name:<40} median {:8.1} ns  best {best:8.1}", all[100]);
}
macro_rules! bare { ($service:ty, $name:expr, $payload:expr) => {{
    use iceoryx2::prelude::*;
    let node = NodeBuilder::new().create::<$service>().unwrap();
    let svc = node.service_builder(&ServiceName::new(&format!("scratch{}", $name)).unwrap()).publish_subscribe::<[u8]>()
        .max_subscribers(topics::FRAME.limits.max_subscribers).max_publishers(topics::FRAME.limits.max_publishers).max_nodes(topics::FRAME.limits.max_nodes)
        .history_size(topics::FRAME.limits.history).subscriber_max_buffer_size(topics::FRAME.limits.buffer)
        .subscriber_max_borrowed_samples(topics::FRAME.limits.borrowed).enable_safe_overflow(true).open_or_create().unwrap();
    let publisher = svc.publisher_builder().initial_max_slice_len(64).max_loaned_samples(topics::FRAME.limits.loaned).create().unwrap();
    let subscriber = svc.subscriber_builder().create().unwrap();
    let event = node.service_builder(&ServiceName::new(&format!("scratch{}", $name)).unwrap()).event().open_or_create().unwrap();
    let notifier = event.notifier_builder().create().unwrap();
    time(&format!("{} send", $name), 100, || { publisher.loan_slice_uninit($payload.len()).unwrap().write_from_slice($payload).send().unwrap(); });
    while subscriber.receive().unwrap().is_some() {}
    time(&format!("{} send+receive", $name), 100, || { publisher.loan_slice_uninit($payload.len()).unwrap().write_from_slice($payload).send().unwrap(); black_box(subscriber.receive().unwrap().unwrap().payload().len()); });
    time(&format!("{} receive none", $name), 100, || { black_box(subscriber.receive().unwrap().is_none()); });
    time(&format!("{} has_samples", $name), 100, || { black_box(subscriber.has_samples().unwrap()); });
    time(&format!("{} notify nobody", $name), 100, || { black_box(notifier.notify().unwrap()); });
    time(&format!("{} listeners", $name), 100, || { black_box(event.dynamic_config().number_of_listeners()); });
}}}
fn main() {
    let payload = vec![7_u8; 63];
    bare!(iceoryx2::prelude::ipc::Service, "ipc", &payload);
    bare!(iceoryx2::prelude::ipc_threadsafe::Service, "threadsafe", &payload);
    let run = Run::new(&format!("scratch-{}", std::process::id()), 1).unwrap();
    let node = Node::open(&run, "x").unwrap();
    let mut publisher = node.image_publisher(&topics::FRAME, 63).unwrap();
    let mut receiver = node.receiver(&topics::FRAME).unwrap().polled();
    let mut meta = FrameMeta { width_px: 7, height_px: 3, intrinsics: Intrinsics { fl_x_px: 1.0, fl_y_px: 1.0, ..Intrinsics::default() }, dataset_view: DatasetView::UNKNOWN, ..FrameMeta::default() };
    time("typed send", 100, || { meta.header = Header::of_frame(0, monotonic_now_ns(), 1); publisher.send_bytes(&payload, meta).unwrap(); });
    while receiver.newest().unwrap().is_some() {}
    time("typed send+newest", 100, || { meta.header = Header::of_frame(0, monotonic_now_ns(), 1); publisher.send_bytes(&payload, meta).unwrap(); black_box(receiver.newest().unwrap().unwrap().bytes().len()); });
    time("typed send+next", 100, || { meta.header = Header::of_frame(0, monotonic_now_ns(), 1); publisher.send_bytes(&payload, meta).unwrap(); black_box(receiver.next().unwrap().unwrap().bytes().len()); });
    time("typed newest none", 100, || { black_box(receiver.newest().unwrap().is_none()); });
    time("typed has_waiting", 100, || { black_box(receiver.has_waiting().unwrap()); });
    time("clock", 100, || { black_box(monotonic_now_ns()); });
    time("validate", 100, || { use carff_messages::Message; black_box(meta.validate().is_ok()); });
    time("spin_loop", 100, || std::hint::spin_loop());
    drop((publisher, receiver, node));
    carff_transport::remove_run_leftovers(&run).unwrap();
}
