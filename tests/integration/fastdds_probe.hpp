// Asks Fast DDS whether one enclave hears another; a part of fastdds_oracle, with which it is compiled
// once.
//
//   fastdds_oracle DOMAIN
//
// Reads questions from standard input, a line each: WRITER_FOLDER READER_FOLDER TOPIC SECONDS.
// Answers each with a line: heard, silent (never matched, or nothing arrived within SECONDS), or what
// was refused: "writer joins", "reader joins", "writer opens", "reader opens".
//
// A crl.pem in a folder is used as the RMWs of ROS 2 use it.

#pragma once

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/log/Log.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/Topic.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/xmlparser/XMLProfileManager.h>

#include <chrono>
#include <cstdint>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <memory>
#include <sstream>
#include <string>
#include <thread>

namespace fast = eprosima::fastdds::dds;
namespace rtps = eprosima::fastrtps::rtps;

// The key as rmw_fastrtps of ROS 2 Jazzy finds it: the PKCS#11 URI in key.p11, or else key.pem.
std::string private_key(const std::string& folder)
{
    std::string uri;
    std::ifstream named(folder + "/key.p11");
    return named >> uri && uri.rfind("pkcs11:", 0) == 0 ? uri : "file://" + folder + "/key.pem";
}

namespace probing
{

// One number, in little-endian CDR.
class NumberType : public fast::TopicDataType
{
public:
    NumberType()
    {
        setName("sros::Number");
        m_typeSize = 8;
        m_isGetKeyDefined = false;
        auto_fill_type_information(false);
        auto_fill_type_object(false);
    }

    bool serialize(void* value, rtps::SerializedPayload_t* payload) override
    {
        const unsigned char header[4] = {0, 1, 0, 0};
        std::memcpy(payload->data, header, 4);
        std::memcpy(payload->data + 4, value, 4);
        payload->length = 8;
        payload->encapsulation = CDR_LE;
        return true;
    }

    bool deserialize(rtps::SerializedPayload_t* payload, void* value) override
    {
        if (payload->length < 8)
        {
            return false;
        }
        std::memcpy(value, payload->data + 4, 4);
        return true;
    }

    std::function<uint32_t()> getSerializedSizeProvider(void*) override
    {
        return [] { return 8u; };
    }

    void* createData() override
    {
        return new std::uint32_t(0);
    }

    void deleteData(void* value) override
    {
        delete static_cast<std::uint32_t*>(value);
    }

    bool getKey(void*, rtps::InstanceHandle_t*, bool) override
    {
        return false;
    }
};

fast::DomainParticipant* join(std::uint32_t domain, const std::string& folder)
{
    fast::DomainParticipantQos qos;
    qos.transport().use_builtin_transports = false;
    qos.transport().user_transports.push_back(
        std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>());
    auto set = [&qos](const std::string& name, const std::string& value)
    {
        qos.properties().properties().emplace_back(name, value);
    };
    const std::string file = "file://" + folder + "/";
    const std::string identity = "dds.sec.auth.builtin.PKI-DH.";
    const std::string access = "dds.sec.access.builtin.Access-Permissions.";
    set("dds.sec.auth.plugin", "builtin.PKI-DH");
    set("dds.sec.access.plugin", "builtin.Access-Permissions");
    set("dds.sec.crypto.plugin", "builtin.AES-GCM-GMAC");
    set(identity + "identity_ca", file + "identity_ca.cert.pem");
    set(identity + "identity_certificate", file + "cert.pem");
    set(identity + "private_key", private_key(folder));
    if (std::filesystem::exists(folder + "/crl.pem"))
    {
        set(identity + "identity_crl", file + "crl.pem");
    }
    set(access + "permissions_ca", file + "permissions_ca.cert.pem");
    set(access + "governance", file + "governance.p7s");
    set(access + "permissions", file + "permissions.p7s");
    return fast::DomainParticipantFactory::get_instance()->create_participant(domain, qos);
}

struct Party
{
    fast::DomainParticipant* participant = nullptr;

    ~Party()
    {
        if (participant)
        {
            participant->delete_contained_entities();
            fast::DomainParticipantFactory::get_instance()->delete_participant(participant);
        }
    }
};

std::string ask(std::uint32_t domain, double seconds, const std::string& from,
        const std::string& to, const std::string& topic)
{
    Party writing, reading;
    if (!(writing.participant = join(domain, from)))
    {
        return "writer joins";
    }
    if (!(reading.participant = join(domain, to)))
    {
        return "reader joins";
    }
    fast::TypeSupport type(new NumberType);
    for (auto* each : {writing.participant, reading.participant})
    {
        type.register_type(each);
    }
    auto* written = writing.participant->create_topic(topic, "sros::Number", fast::TOPIC_QOS_DEFAULT);
    auto* publisher = writing.participant->create_publisher(fast::PUBLISHER_QOS_DEFAULT);
    auto* writer = publisher->create_datawriter(written, fast::DATAWRITER_QOS_DEFAULT);
    if (!writer)
    {
        return "writer opens";
    }
    fast::DataReaderQos reliable = fast::DATAREADER_QOS_DEFAULT;
    reliable.reliability().kind = fast::RELIABLE_RELIABILITY_QOS;
    auto* read = reading.participant->create_topic(topic, "sros::Number", fast::TOPIC_QOS_DEFAULT);
    auto* subscriber = reading.participant->create_subscriber(fast::SUBSCRIBER_QOS_DEFAULT);
    auto* reader = subscriber->create_datareader(read, reliable);
    if (!reader)
    {
        return "reader opens";
    }
    const auto begin = std::chrono::steady_clock::now();
    while (std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count() < seconds)
    {
        std::uint32_t said = 42, heard = 0;
        writer->write(&said);
        fast::SampleInfo info;
        if (reader->take_next_sample(&heard, &info) == ReturnCode_t::RETCODE_OK
                && info.valid_data && heard == said)
        {
            return "heard";
        }
        std::this_thread::sleep_for(std::chrono::milliseconds(20));
    }
    return "silent";
}

int probe(std::uint32_t domain)
{
    std::string line, from, to, topic;
    double seconds;
    while (std::getline(std::cin, line))
    {
        std::istringstream(line) >> from >> to >> topic >> seconds;
        std::cout << ask(domain, seconds, from, to, topic) << std::endl;
    }
    return 0;
}

}  // namespace probing
