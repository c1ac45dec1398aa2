//! Two eyes in one render, with a sort for each and with one.

use super::*;

#[test]
fn two_eyes_of_one_sort_are_those_of_a_sort_for_each() {
    let session = Session::ready(|_| {});
    let mut eyes = [c_camera(); 2];
    eyes[1].view_from_world[3] = -0.065;
    let color = NspImage { layers: 2, ..session.image() };
    let mut frame = 0;
    let mut drawn = |flags| {
        frame += 1;
        let commands = session.host.begin();
        let render =
            NspRender { camera_count: 2, flags, ..render(commands, frame, &eyes[0], &color) };
        // SAFETY: everything is valid, and the command buffer is recording.
        ok(unsafe { nsp_record_render(session.renderer, session.model, &render) });
        session.host.submit_frame(commands, frame);
        session.host.wait_frame(frame);
        session.host.read_picture(session.picture.as_ref().unwrap(), PIXELS)
    };
    let apart = drawn(0);
    assert_ne!(apart[0], apart[1]);
    assert_eq!(drawn(NSP_RENDER_ONE_SORT), apart);
    session.end();
}
